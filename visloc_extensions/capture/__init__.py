"""`mapping capture`: from a phone's videos and photos to a published map. Needs ``films``."""
