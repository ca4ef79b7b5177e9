"""The program: ``visctrl``, or ``python -m visctrl``."""

from __future__ import annotations

import os
import signal
from types import FrameType

_INTERRUPTED = 130


def _leave(number: int, frame: FrameType | None) -> None:
    """End at once: nothing has been started, and imports must not be interrupted halfway."""
    os.write(2, b"visctrl: stopped by Ctrl-C\n")
    os._exit(_INTERRUPTED)


def main() -> None:
    """Run the command line."""
    # Importing takes a while, in which there is nothing yet that could be left in disorder.
    signal.signal(signal.SIGINT, _leave)
    from visctrl.cli.main import main as run

    run()


if __name__ == "__main__":
    main()
