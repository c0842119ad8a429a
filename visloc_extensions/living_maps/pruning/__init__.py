"""``mapping prune``: a smaller version of a map, of what localization needs most."""

from visloc_extensions.living_maps.pruning.choosing import Kept, choose, size_with
from visloc_extensions.living_maps.pruning.job import Pruned, prune_map

__all__ = ["Kept", "Pruned", "choose", "prune_map", "size_with"]
