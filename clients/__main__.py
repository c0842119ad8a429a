"""``python -m clients`` is the ``localize`` command."""

from clients.cli import main

main()
