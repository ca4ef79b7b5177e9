"""``python -m visctrl``."""

from visctrl.cli.main import main

if __name__ == "__main__":
    main()
