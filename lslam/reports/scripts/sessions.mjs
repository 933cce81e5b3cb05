// Several trajectories on one map: merged runs, or the runs of a comparison; null on the page of one run.
import { read } from "./elements.mjs";
import { nearestBy, unpack } from "./numbers.mjs";

/** Trajectories with their positions, and those before, where they were merged; null on the page of one run. */
export const sessions = (() => {
  const data = read("sessions");
  if (!data) return null;
  data.ties = unpack(data.ties, Float32Array);
  for (const session of data.sessions) {
    session.index = unpack(session.index, Int32Array);
    for (const name of ["positions", "before"]) if (session[name]) session[name] = unpack(session[name], Float32Array);
  }
  return data;
})();

/** Where a trajectory is drawn: as it is, or as it was before. */
export function placesOf(session) {
  return sessions.isBefore ? session.before : session.positions;
}

/** The scan of a merged run that is seen nearest to px; null further away than 30. */
export function sessionAt(x, y) {
  let [found, least] = [null, 30];
  for (const session of sessions.sessions) {
    const k = nearestBy(Float32Array.from({ length: session.index.length }, (_, i) => Math.hypot(session.way[2 * i] - x, session.way[2 * i + 1] - y)), 0);
    const away = k < 0 ? Infinity : Math.hypot(session.way[2 * k] - x, session.way[2 * k + 1] - y);
    if (away < least) [found, least] = [{ session, k }, away];
  }
  return found;
}
