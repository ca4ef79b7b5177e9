"""``visctrl observability`` on a planned motion, and what it refuses."""

import json

import pytest

from visctrl.cli.observability import observability
from visctrl.robots.errors import InputError


def judge(*outputs: str, start: tuple[float, float, float] | None = (-8.0, -12.0, -20.0)) -> int:
    return observability(
        None, start, list(outputs),
        tau_s=100.0, period_s=0.5, window=10, offset_m=0.08, as_json=True, out=None,
    )  # fmt: skip


def test_epipoles_tell_the_pose_along_the_path_and_t111_never_does(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert judge("epipoles", "T111") == 0
    epipoles, t111 = json.loads(capsys.readouterr().out)
    assert epipoles["windows_lost"] == 0
    assert epipoles["least_singular_value"] > 1e-3
    assert t111["windows_lost"] == t111["windows"] > 10
    assert t111["filter_believes"] > 0


def test_wrong_input_is_refused() -> None:
    with pytest.raises(InputError, match="give either"):
        judge(start=None)
    with pytest.raises(InputError, match="T121: unknown; known: epipoles"):
        judge("T121")
    with pytest.raises(InputError, match="choose y < 0"):
        judge("epipoles", start=(0.0, 1.0, 0.0))
