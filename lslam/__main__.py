"""`python -m lslam`."""

from lslam.cli.main import main

if __name__ == "__main__":
    main()
