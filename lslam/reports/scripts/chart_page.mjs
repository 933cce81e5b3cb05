// The script of a page with charts. Pages are whole without it; nothing is fetched.
import { startBar, startPrinting } from "./bar.mjs";
import { startCharts } from "./charts.mjs";
import { startPictures } from "./picture.mjs";
import { startSorting } from "./sortable.mjs";

startBar();
startPrinting();
for (const hint of document.querySelectorAll(".hint")) hint.hidden = false;
startCharts();
startPictures();
startSorting();
