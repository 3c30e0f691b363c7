"""`python -m commonmap`: the command line."""

from commonmap.cli import main

if __name__ == "__main__":
    main()
