"""New problem files, from answers or from a file of matrices.

``draft`` builds a problem part by part, proposes parameters, and writes the file with a comment for each key.
``commands`` has the command ``new``, which asks for what is missing.
"""
