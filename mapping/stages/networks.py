"""Feature extractors and global descriptors, opened once in every process."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from visloc.errors import refuse
from visloc.features import (
    GlobalDescriptor,
    LocalFeatureExtractor,
    make_global_descriptor,
    make_local_features,
)
from visloc.options import Inference
from visloc.types import Fingerprint


@dataclass(frozen=True, slots=True)
class ExtractorProperties:
    """Properties of a feature extractor; see ``LocalFeatureExtractor``."""

    fingerprint: Fingerprint
    descriptor_dim: int
    computed_with: str


@dataclass(frozen=True, slots=True)
class Networks:
    """The folder of weights, and the way to run networks."""

    weights_dir: Path | None
    inference: Inference

    def extractor(self, name: str) -> LocalFeatureExtractor:
        """Return this process's extractor."""
        return open_extractor(name, self)

    def properties(self, name: str) -> ExtractorProperties:
        """Return the properties of an extractor; raises what ``extractor`` raises."""
        found = self.extractor(name)
        return ExtractorProperties(found.fingerprint, found.descriptor_dim, found.computed_with)

    def descriptor(self, name: str) -> GlobalDescriptor:
        """Return this process's global descriptor; raises what ``extractor`` raises."""
        return open_descriptor(name, self)


@cache
def open_extractor(name: str, networks: Networks) -> LocalFeatureExtractor:
    """Make an extractor once per process, for one thread, as executors need it."""
    return make_local_features(name, networks.weights_dir, networks.inference, threads=1)


@cache
def open_descriptor(name: str, networks: Networks) -> GlobalDescriptor:
    """Make a global descriptor once per process, for one thread."""
    return make_global_descriptor(name, networks.weights_dir, networks.inference, threads=1)


def refuse_other_computing(name: str, expected: str | None, here: str | None) -> None:
    """Refuse a machine whose results would differ from those of the machine that builds."""
    if here != expected:
        raise refuse(
            "build.other_computing", field="--inference", expected=expected, got=here, name=name
        )
