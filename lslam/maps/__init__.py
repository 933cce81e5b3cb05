"""Maps built from posed scans: the merged map, occupancy, surfaces, and scores of maps."""
