"""``python -m clients`` is the ``localize`` command."""

from clients.cli.main import main

main()
