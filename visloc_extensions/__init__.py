"""Extensions: folders that can be deleted, with their tests, their page and their lines.

The core (``visloc``, ``mapping``, ``service``, ``clients``, ``visloc_api``) imports none of them;
``pyproject.toml`` registers what each adds (``visloc.extensions``).
"""
