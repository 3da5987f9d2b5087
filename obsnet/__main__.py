"""``python -m obsnet``."""

from obsnet.cli import main

if __name__ == "__main__":
    main()
