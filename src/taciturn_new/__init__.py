"""New problem files, from answers or from a file of matrices.

``draft`` builds a problem part by part from text (``matrices``) or from a file of matrices, proposes parameters, and
writes the file with a comment for each key. ``commands`` has the command ``new``, which asks for missing
values.
"""
