// The script of a run's page.
import "./map_page.mjs";
import "./corrections.mjs";
import "./tiles.mjs";
