# SPDX-License-Identifier: GPL-3.0-or-later
"""`python -m fruitlangs` is the command `fruitlangs`."""

from .scripts.commands import main

if __name__ == "__main__":
    main()
