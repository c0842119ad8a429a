"""Adds ``mapping export-graph``: with it, OpenVINO computes networks with weights of your own."""
