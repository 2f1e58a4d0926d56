"""The command line: each command reads a problem file, calls a function of the package and prints the result.

A command has three parts. It checks its options before a long computation starts. It calls the function that Python
users call, such as ``taciturn.evaluate``, so both get the same numbers. It prints ``str`` of the result, in 80 columns,
or with ``--json`` one document that contains version, seed, method and the problem's digest.

``frame`` contains the application, the options that several commands share, and ``main``. ``main`` turns each error of
the library into one sentence on standard error and exit code 2, so commands raise errors and do not handle them.
``usage`` reads the words of the command line, and has the sentences about mistakes in them. ``answers`` contains the
commands ``evaluate``, ``show`` and ``simulate``. Other packages add commands by entry points of the group
``taciturn.commands``.

Commands import large modules only when they run, so that ``--help`` and the shell's completion are fast.
"""

from taciturn._process import ends_on_signals

with ends_on_signals():  # these imports take most of the time of a short command
    from taciturn.cli import answers
    from taciturn.cli.frame import add_commands, app, main

    add_commands()

__all__ = ["answers", "app", "main"]
