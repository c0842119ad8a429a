"""The command ``python -m visloc_extensions.training``."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from visloc.errors import VislocError, refuse
from visloc.features import make_local_features
from visloc_extensions.training.checkpoint import FILE_NAME, State, load_state
from visloc_extensions.training.export import export
from visloc_extensions.training.pairs import make_sources
from visloc_extensions.training.parallax import pack_rooms, read_rooms
from visloc_extensions.training.photos import pack_photos, read_pack
from visloc_extensions.training.plots import draw
from visloc_extensions.training.run import Trainer, resume, train
from visloc_extensions.training.settings import PRESETS, Settings
from visloc_extensions.training.validation import (
    CHANGES,
    Score,
    features_of,
    validate,
    validation_pairs,
)

DATA = Path(".training")
_CPU = torch.device("cpu")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    options = _parser().parse_args(arguments)
    try:
        return int(options.run(options))
    except VislocError as error:
        sys.stderr.write(f"{error}\n")
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m visloc_extensions.training", description=__doc__
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    pack = commands.add_parser("pack", help="pack photos into one file")
    pack.add_argument("source", type=Path, help="folder of folders of photos, with SOURCES.tsv")
    pack.add_argument("--output", type=Path, default=DATA / "photos.safetensors")
    pack.add_argument("--research", action="store_true", help="also what forbids commercial use")
    pack.add_argument("--validation", action="store_true", help="those held back, and no others")
    pack.set_defaults(run=_pack)

    rooms = commands.add_parser("rooms", help="photograph synthetic rooms, for true parallax")
    rooms.add_argument("--output", type=Path, default=DATA / "rooms.safetensors")
    rooms.add_argument("--rooms", type=int, default=6)
    rooms.add_argument("--places", type=int, default=24, help="per room, three photos at each")
    rooms.add_argument("--seed", type=int, default=1000)
    rooms.set_defaults(run=_rooms)

    run = commands.add_parser("run", help="train")
    run.add_argument("folder", type=Path, help="where checkpoint and log go")
    run.add_argument("--preset", choices=PRESETS, default="published")
    run.add_argument("--start-from", type=Path, help="checkpoint whose weights to begin with")
    for each in dataclasses.fields(Settings):
        name = "--" + each.name.replace("_", "-")
        meaning = f"{each.metadata['meaning']} (published: {each.default})"
        if isinstance(each.default, bool):
            run.add_argument(name, action=argparse.BooleanOptionalAction, help=meaning)
        else:
            run.add_argument(name, type=type(each.default), help=meaning, metavar="N")
    _add_running(run)
    run.add_argument("--fit-seconds", type=float, help="time steps, and do no more than fit")
    run.set_defaults(run=_run)

    again = commands.add_parser("resume", help="go on training where a run stopped")
    again.add_argument("folder", type=Path, help="of the run")
    _add_running(again)
    again.set_defaults(run=_resume, fit_seconds=None)

    check = commands.add_parser("validate", help="how well features match held-back photos")
    check.add_argument("features", nargs="*", help="names of local features")
    check.add_argument("--checkpoints", type=Path, nargs="*", default=[], help="of training")
    check.add_argument("--weights-dir", type=Path)
    check.add_argument("--validation", type=Path, default=DATA / "validation.safetensors")
    check.add_argument("--per-photo", type=int, default=1, help="pairs of each photo")
    check.add_argument("--change", choices=CHANGES, default="mixed", help="what alters photos")
    check.add_argument("--of-first", help="name of local features for the first photos")
    check.add_argument("--output", type=Path, help="append a line of JSON for each")
    check.set_defaults(run=_validate)

    ship = commands.add_parser("export", help="write a checkpoint as weights for visloc")
    ship.add_argument("checkpoint", type=Path)
    ship.add_argument("output", type=Path, help="faster2d2.safetensors in a weights folder")
    ship.set_defaults(run=_export)

    plots = commands.add_parser("plots", help="draw losses and validation of a run")
    plots.add_argument("folder", type=Path, help="of the run")
    plots.add_argument("--beside", type=Path, help="what validate --output wrote of others")
    plots.set_defaults(run=_plots)
    return parser


def _add_running(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--photos", type=Path, default=DATA / "photos.safetensors", help="a pack")
    parser.add_argument(
        "--rooms", type=Path, default=DATA / "rooms.safetensors", help="for --parallax-share"
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, help="of the processor")
    parser.add_argument("--for-seconds", type=float, help="then stop; resume goes on")
    parser.add_argument("--checkpoint-every-s", type=float, default=60.0)
    parser.add_argument("--validate-every", type=int, help="steps; needs --validation")
    parser.add_argument("--validation", type=Path, default=DATA / "validation.safetensors")


def _pack(options: argparse.Namespace) -> int:
    number = pack_photos(
        options.source, options.output, research=options.research, validation=options.validation
    )
    sys.stdout.write(f"{number} photos in {options.output}\n")
    return 0


def _rooms(options: argparse.Namespace) -> int:
    number = pack_rooms(
        options.output, rooms=options.rooms, places=options.places, seed=options.seed
    )
    sys.stdout.write(f"{number} photos of rooms in {options.output}\n")
    return 0


def _run(options: argparse.Namespace) -> int:
    if (options.folder / FILE_NAME).exists():
        raise refuse("training.exists", field=str(options.folder))
    changed = {
        each.name: getattr(options, each.name)
        for each in dataclasses.fields(Settings)
        if getattr(options, each.name) is not None
    }
    trainer = _trainer(dataclasses.replace(PRESETS[options.preset], **changed), options)
    if options.start_from is not None:
        trainer.start_from(load_state(options.start_from, trainer.sources.device))
    return _train(trainer, options)


def _resume(options: argparse.Namespace) -> int:
    settings = load_state(options.folder / FILE_NAME, torch.device("cpu")).settings
    trainer = _trainer(settings, options)
    resume(trainer, options.folder)
    return _train(trainer, options)


def _trainer(settings: Settings, options: argparse.Namespace) -> Trainer:
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    device = torch.device(options.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise refuse("training.device", field="device", got="cuda")
    pack = read_pack(options.photos)
    described = {
        "photos_sha256": pack.sha256,
        "photos": str(len(pack.photos)),
        "licences": "; ".join(f"{n} {each}" for each, n in sorted(pack.licences.items())),
    }
    places = read_rooms(options.rooms) if settings.parallax_share else ()
    if places:
        described["rooms_sha256"] = hashlib.sha256(options.rooms.read_bytes()).hexdigest()
    return Trainer(settings, make_sources(pack.photos, places, device), described)


def _train(trainer: Trainer, options: argparse.Namespace) -> int:
    asked_to_stop = []
    signal.signal(signal.SIGTERM, lambda *_: asked_to_stop.append(True))
    signal.signal(signal.SIGINT, lambda *_: asked_to_stop.append(True))
    finished = train(
        trainer,
        options.folder,
        seconds=options.for_seconds,
        checkpoint_every_s=options.checkpoint_every_s,
        should_stop=lambda: bool(asked_to_stop),
        validate_every=options.validate_every,
        validated=_validation(options),
        fit_seconds=options.fit_seconds,
    )
    how = "finished" if finished else "stopped; resume goes on"
    sys.stdout.write(f"step {trainer.step} of {trainer.settings.steps}: {how}\n")
    return 0


def _validation(options: argparse.Namespace) -> Callable[[State], Score] | None:
    if options.validate_every is None:
        return None
    pairs = validation_pairs(read_pack(options.validation).photos)
    return lambda state: validate(features_of(state), pairs)


def _validate(options: argparse.Namespace) -> int:
    photos = read_pack(options.validation).photos
    pairs = validation_pairs(photos, options.per_photo, CHANGES[options.change])
    of_first = None
    if options.of_first is not None:
        of_first = make_local_features(options.of_first, options.weights_dir)
    sys.stdout.write(
        f"{len(pairs)} pairs\n\n| features | right within 1 px | 3 px | 5 px | right matches"
        " | keypoints | repeatable |\n|---|---|---|---|---|---|---|\n"
    )
    for name in [*options.features, *options.checkpoints]:
        if isinstance(name, Path):
            extractor = features_of(load_state(name, _CPU))
        else:
            extractor = make_local_features(name, options.weights_dir)
        score = validate(extractor, pairs, of_first=of_first)
        accuracy = " | ".join(f"{100 * each:.1f} %" for each in score.matching_accuracy)
        sys.stdout.write(
            f"| {name} | {accuracy} | {score.right_matches:.0f} | {score.keypoints:.0f}"
            f" | {100 * score.repeatability:.1f} % |\n"
        )
        sys.stdout.flush()
        if options.output is not None:
            with options.output.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"features": str(name), **dataclasses.asdict(score)}) + "\n")
    return 0


def _export(options: argparse.Namespace) -> int:
    size = export(load_state(options.checkpoint, _CPU), options.output)
    sha256 = hashlib.sha256(options.output.read_bytes()).hexdigest()
    sys.stdout.write(f"{options.output}: {size} bytes, sha256 {sha256}\n")
    return 0


def _plots(options: argparse.Namespace) -> int:
    for path in draw(options.folder, options.beside):
        sys.stdout.write(f"{path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
