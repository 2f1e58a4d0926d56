"""The value of a parameter, or of the period, at which a policy keeps a budget of cost or rate.

``tune`` searches (``search``) with evaluations that are only as precise as the search needs (``trials``), and returns
the ``tuned`` problem. ``budget`` reads budgets in percent, and ``periods`` varies the period and the parameter jointly.
"""
