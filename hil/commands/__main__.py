"""`python -m hil.commands` is `floaty`."""

from hil.commands.app import main

main()
