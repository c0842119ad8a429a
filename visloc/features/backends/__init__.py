"""How networks are computed: torch or OpenVINO."""
