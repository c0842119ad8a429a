"""Adds ``python -m visloc_extensions.training``: trains networks from photographs, our own weights.

Fast-R2D2 (or R2D2) learns from nothing, as the papers say (Revaud et al., NeurIPS 2019; Humenberger
et al. 2020, appendix): weights that others published, and what such networks say about photos, have
no part in it. XFeat begins with its published weights, which are free (Apache-2.0), and has them as
its teacher (``visloc_extensions.training.distillation``).

Pixels as everywhere here: the centre of the top-left one is (0.5, 0.5). A flow is (..., H, W, 2):
where (x, y) in the second image the centre of each pixel of the first one is seen, NaN where
nothing is known.
"""
