"""OpenStreetMap as prior knowledge: fetched buildings, walls seen in clouds, and how the two are matched."""
