"""Many loops on one channel, with a bound below the cost of every scheduler.

``share`` compares schedulers of loops in classes (``loop_classes``), at the price of a send at which their load equals
the capacity (``prices``). ``schedulers`` combine a rule of ``access`` with the urgency of each loop; ``simulated`` runs
the errors of all loops.
"""
