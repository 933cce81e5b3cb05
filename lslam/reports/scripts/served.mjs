// The server of `lslam view`, which answers its own page. A page that is a file asks nobody.
import { read } from "./elements.mjs";

/** Whether the page is served. */
export const served = read("served") !== null;

/** The server's answer, below the page's address. Raises Error with its sentence. */
async function reach(path, told) {
  if (!served) throw new Error("the page is a file: lslam view serves it");
  const answer = await fetch(path, told).catch(() => {
    throw new Error("lslam view does not answer: it has ended");
  });
  if (!answer.ok) throw new Error((await answer.json()).error || answer.statusText);
  return answer;
}

/** What the server says, or says to a `document`. */
export async function ask(path, document) {
  const told = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(document) };
  return (await reach(path, document === undefined ? {} : told)).json();
}

export async function askBytes(path) {
  return (await reach(path, {})).arrayBuffer();
}
