"""Many control loops that share a channel, which carries only a few packets at a time.

``share`` has ``taciturn.share_channel``. ``classes`` groups loops that are alike and finds their best periodic control,
``prices`` the price of a send and lower bounds, ``schedulers`` who sends, and ``simulated`` the errors of all loops.
``commands`` has the command ``channel``.
"""
