from __future__ import annotations

from pathlib import Path

import pytest

from service.settings import ServiceSettings, SettingsError, read_settings


def test_everything_has_a_default_and_only_this_machine_is_served() -> None:
    settings = read_settings([], {})

    assert settings == ServiceSettings()
    assert settings.host == "127.0.0.1"
    assert (settings.http_port, settings.grpc_port) == (8000, 50051)


def test_a_flag_beats_the_environment_which_beats_the_file_which_beats_the_default(
    tmp_path: Path,
) -> None:
    file = tmp_path / "visloc.toml"
    file.write_text('http_port = 1\ngrpc_port = 1\nmax_queue = 1\nmaps_dir = "file"\n')
    environment = {"VISLOC_HTTP_PORT": "2", "VISLOC_GRPC_PORT": "2", "HOME": "/root"}

    settings = read_settings(["--config", str(file), "--http-port=3"], environment)

    assert (settings.http_port, settings.grpc_port, settings.max_queue) == (3, 2, 1)
    assert settings.maps_dir == "file"
    assert settings.max_batches == 8


def test_the_environment_can_name_the_file_and_the_flag_replaces_it(tmp_path: Path) -> None:
    one, two = tmp_path / "one.toml", tmp_path / "two.toml"
    one.write_text("workers = 5")
    two.write_text("workers = 6")

    assert read_settings([], {"VISLOC_CONFIG": str(one)}).workers == 5
    assert read_settings(["--config", str(two)], {"VISLOC_CONFIG": str(one)}).workers == 6


@pytest.mark.parametrize("name", ServiceSettings.model_fields)
def test_every_setting_has_a_flag_a_variable_and_a_line_of_help(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = {
        "cors_origins": "https://a.example,https://b.example",
        "host": "::1",
        "inference": "fp32",
        "log_format": "json",
        "log_level": "error",
        "page": "false",
    }
    value = words.get(name, "7")
    flag, variable = "--" + name.replace("_", "-"), "VISLOC_" + name.upper()

    by_flag, by_variable = read_settings([flag, value], {}), read_settings([], {variable: value})
    with pytest.raises(SystemExit):
        read_settings(["--help"], {})

    assert getattr(by_flag, name) == getattr(by_variable, name) != getattr(ServiceSettings(), name)
    assert flag in capsys.readouterr().out
    assert ServiceSettings.model_fields[name].description


@pytest.mark.parametrize(
    ("variable", "close"),
    [("VISLOC_MAP_DIR", "VISLOC_MAPS_DIR"), ("VISLOC_HTTPPORT", "VISLOC_HTTP_PORT")],
)
def test_a_misspelt_variable_is_refused_with_what_was_probably_meant(
    variable: str, close: str
) -> None:
    with pytest.raises(SettingsError, match=f"unknown setting {variable}; known: .*{close}"):
        read_settings([], {variable: "x"})


def test_an_unknown_key_of_the_file_is_refused_with_what_was_probably_meant(
    tmp_path: Path,
) -> None:
    file = tmp_path / "visloc.toml"
    file.write_text("grpcport = 1")

    with pytest.raises(SettingsError, match=r"visloc\.toml: unknown setting grpcport.*grpc_port"):
        read_settings(["--config", str(file)], {})


def test_an_unknown_or_shortened_flag_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["--gpu"], ["--http", "1"]):
        with pytest.raises(SystemExit):
            read_settings(arguments, {})
    assert "unrecognized arguments: --gpu" in capsys.readouterr().err


def test_a_wrong_value_is_refused_with_the_place_where_it_was_given(tmp_path: Path) -> None:
    file = tmp_path / "visloc.toml"
    file.write_text("workers = 0")

    with pytest.raises(SettingsError, match=r"^--http-port: http_port cannot be '70000'"):
        read_settings(["--http-port", "70000"], {})
    with pytest.raises(SettingsError, match=r"^VISLOC_MAX_QUEUE: max_queue cannot be '-1'"):
        read_settings([], {"VISLOC_MAX_QUEUE": "-1"})
    with pytest.raises(SettingsError, match=r"visloc\.toml: workers cannot be 0"):
        read_settings([], {"VISLOC_CONFIG": str(file)})


def test_a_file_that_is_absent_or_no_toml_is_refused(tmp_path: Path) -> None:
    broken = tmp_path / "broken.toml"
    broken.write_bytes(b"workers = \xff")

    with pytest.raises(SettingsError, match=r"absent\.toml: .* cannot be read"):
        read_settings(["--config", str(tmp_path / "absent.toml")], {})
    with pytest.raises(SettingsError, match=r"broken\.toml: not a TOML file"):
        read_settings(["--config", str(broken)], {})


def test_an_empty_variable_counts_as_absent() -> None:
    assert read_settings([], {"VISLOC_WEIGHTS_DIR": "", "VISLOC_CONFIG": ""}).weights_dir is None


@pytest.mark.parametrize(
    ("cores", "gibibytes", "workers"),
    [(8, 64, 8), (8, 3.9, 3), (8, 0.5, 1), (1, 64, 1), (8, None, 8)],
)
def test_there_are_as_many_workers_as_cores_and_memory_allow(
    cores: int, gibibytes: float | None, workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = None if gibibytes is None else int(gibibytes * 2**30)
    monkeypatch.setattr("service.settings.usable_cores", lambda: cores)
    monkeypatch.setattr("service.settings.memory_limit", lambda: memory)

    settings = read_settings([], {})

    assert (settings.workers, settings.threads_per_worker) == (workers, cores)
    assert read_settings(["--workers", "20"], {}).workers == 20
    assert read_settings(["--threads-per-worker", "4"], {}).threads_per_worker == 4


def test_a_request_has_room_for_the_largest_photo_in_base64() -> None:
    settings = ServiceSettings(max_image_bytes=3_000_000)

    assert settings.max_json_bytes > 4_000_000
    assert settings.max_request_bytes > 3_000_000
