"""The renderer asked for draws or is refused."""

import pytest

from visctrl.hal.errors import InputError
from visctrl.sim.render import renderer_choice as drawers

pytestmark = pytest.mark.sim


def test_what_does_not_work_is_refused_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawers, "gl_problem", lambda: "no driver: install one")
    assert drawers.choose_drawer("tiny") == "tiny"
    with pytest.raises(InputError, match=r"renderer 'gl': no driver: install one"):
        drawers.choose_drawer("gl")
