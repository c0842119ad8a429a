"""Commands of ``localize``, which asks a service: they load nothing heavy."""
