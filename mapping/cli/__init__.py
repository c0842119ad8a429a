"""The ``mapping`` command."""
