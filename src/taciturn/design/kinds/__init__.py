"""The policy kinds, one per file. A file contains the design function of a kind and, at its end, the record ``KIND``.

A file has the name of its kind, with underscores in place of hyphens. The catalogue lists the files of this folder, so
a new kind needs no other entry.
"""
