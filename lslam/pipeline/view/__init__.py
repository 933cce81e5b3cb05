"""A run in the browser: a server on this machine, with tiles of the map and corrections of the graph."""
