"""The chapters of the thesis: their tables and figures, with printed and computed numbers side by side.

``reproduce`` finds a chapter by name, and ``chapter2`` to ``chapter7`` compute them. ``reproduction`` holds the tables
and figures. ``commands`` adds the command ``taciturn reproduce``.
"""
