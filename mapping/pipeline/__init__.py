"""From a dataset to a published map, stage by stage."""
