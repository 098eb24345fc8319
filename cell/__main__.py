"""`python -m cell`: the same as the command `cell`."""

from cell.cli import main

main()
