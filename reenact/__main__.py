"""`python -m reenact` is the command `reenact`."""

from reenact.cli import main

raise SystemExit(main())
