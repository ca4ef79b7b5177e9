"""Cameras of every projection model, with parameters as real ones have them."""

from __future__ import annotations

from hypothesis import strategies as st

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.models.double_sphere import DoubleSphereCamera
from visctrl.hal.cameras.models.extended_unified import ExtendedUnifiedCamera
from visctrl.hal.cameras.models.kannala_brandt import KannalaBrandtCamera
from visctrl.hal.cameras.models.ocam import OcamCamera
from visctrl.hal.cameras.models.pinhole_radtan import PinholeRadtanCamera
from visctrl.hal.cameras.models.unified import UnifiedCamera
from visctrl.hal.cameras.models.unified_radtan import UnifiedRadtanCamera

#: Fields of the picture and the mounting that all of them share.
BASE = {"name": "any", "width": 640, "height": 480, "cx": 322.3, "cy": 236.1}


def between(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


_COMMON = {
    "name": st.just("any"),
    "width": st.just(640),
    "height": st.just(480),
    "cx": between(290.0, 350.0),
    "cy": between(210.0, 270.0),
    "max_polar_deg": between(40.0, 180.0),
}
_K = {
    "fx": between(150, 600) | between(-600, -150),
    "fy": between(150, 600),
    "skew": between(-3, 3),
}
_TANGENTIAL = between(-2e-3, 2e-3)

STRATEGIES: dict[str, st.SearchStrategy[CentralCamera]] = {
    "unified": st.builds(UnifiedCamera, **_COMMON, **_K, xi=between(0, 2.5)),
    "unified-radtan": st.builds(
        UnifiedRadtanCamera,
        **_COMMON,
        **_K,
        xi=between(0.3, 2.5),
        k1=between(-0.35, 0.2),
        k2=between(-0.1, 0.4),
        p1=_TANGENTIAL,
        p2=_TANGENTIAL,
    ),
    "pinhole-radtan": st.builds(
        PinholeRadtanCamera,
        **_COMMON,
        **_K,
        k1=between(-0.4, 0.4),
        k2=between(-0.2, 0.3),
        p1=_TANGENTIAL,
        p2=_TANGENTIAL,
        k3=between(-0.1, 0.3),
        k4=st.just(0.0) | between(-0.1, 0.5),
        k5=st.just(0.0) | between(0, 0.3),
        k6=st.just(0.0) | between(0, 0.1),
    ),
    "kannala-brandt": st.builds(
        KannalaBrandtCamera,
        **_COMMON,
        **_K,
        k1=between(-0.1, 0.1),
        k2=between(-0.05, 0.05),
        k3=between(-0.02, 0.02),
        k4=between(-0.005, 0.005),
    ),
    "double-sphere": st.builds(
        DoubleSphereCamera, **_COMMON, **_K, xi=between(-0.6, 1.0), alpha=between(0, 0.9)
    ),
    "extended-unified": st.builds(
        ExtendedUnifiedCamera, **_COMMON, **_K, alpha=between(0, 0.9), beta=between(0.5, 2.0)
    ),
    "ocam": st.builds(
        OcamCamera,
        **_COMMON,
        polynomial=st.tuples(
            between(90, 300), st.just(0.0), between(-3e-3, -2e-4), between(-1e-6, 1e-6)
        ),
        affine=st.tuples(
            st.just(1.0) | st.just(-1.0),
            between(-1e-3, 1e-3),
            between(-1e-3, 1e-3),
            between(0.99, 1.01),
        ),
    ),
}
