"""The offline job: builds maps and edits them, with the ``mapping`` command."""
