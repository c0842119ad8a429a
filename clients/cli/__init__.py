"""The ``localize`` command."""
