"""The command line as ``python -m taciturn``.

``python -m taciturn.cli``.
"""

from __future__ import annotations

from taciturn.cli.frame import main

if __name__ == "__main__":
    main()


if __name__ == "__main__":
    main()
