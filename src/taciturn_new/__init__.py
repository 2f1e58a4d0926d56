"""New problem files, written from a user's answers to questions or from a file of matrices.

``commands`` has the command ``new``. ``questions`` asks, repeats and keeps answers, and ``interview`` has the questions
in their order. ``matrices`` reads matrices and noise from text. ``draft`` builds the problem part by part and proposes
parameters, and ``text`` writes its file with a comment for each key.
"""
