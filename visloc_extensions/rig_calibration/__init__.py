"""``mapping calibrate-rig``: the cameras of a rig, from poses of their photos."""
