"""``python -m zstate``: the command line."""

from zstate.cli.main import main

main()
