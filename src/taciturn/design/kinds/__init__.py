"""The policy kinds, one per file: the design function and, at the end, the record ``KIND``.

A file has the name of its kind, with underscores in place of hyphens. The catalogue lists the files of this folder, so
a new kind needs no other entry.
"""
