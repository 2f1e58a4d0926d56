"""Entry point of ``python -m taciturn``, which runs the command line."""

from taciturn.cli.frame import main

if __name__ == "__main__":
    main()
