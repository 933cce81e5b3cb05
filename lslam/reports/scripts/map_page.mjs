// The script of a page with a map. A map in 3D takes the place of its drawing before the charts start.
import "./tools.mjs";
import { startSwitches } from "./switches.mjs";
import { mapView } from "./view.mjs";
import "./chart_page.mjs";

startSwitches(() => mapView?.drawer && mapView.draw());
