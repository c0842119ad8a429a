"""The engine in the main process: maps, sets of maps, uploads, and tasks for workers."""
