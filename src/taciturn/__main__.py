"""The command line as ``python -m taciturn``."""

from taciturn.cli.frame import main

if __name__ == "__main__":
    main()
