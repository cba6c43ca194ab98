"""`python -m farside`: the command line."""

from node.__main__ import main

if __name__ == "__main__":
    main()
