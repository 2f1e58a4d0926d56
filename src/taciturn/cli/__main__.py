"""``python -m taciturn.cli``."""

from taciturn.cli.frame import main

if __name__ == "__main__":
    main()
