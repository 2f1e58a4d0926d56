"""Tables and figures of the thesis by chapter; printed and computed numbers stand side by side.

``reproduce`` finds a chapter by name, and ``chapter2`` to ``chapter7`` compute them. ``reproduction`` holds the tables
and figures. ``commands`` adds the command ``taciturn reproduce``.
"""
