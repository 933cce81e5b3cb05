"""A drive located in a map that exists already: place recognition for the start, then registration of scans to the map."""
