"""Importers of reconstructions of Bundler, VisualSFM (NVM), OpenMVG and OpenSfM."""
