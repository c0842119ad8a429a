"""A bench for researchers: comparing, scoring, submitting, public data sets, files of hloc.

It needs the extension ``importers``, whose NVM reader data sets use.
"""
