// The server of `lslam view`, which answers its own page.
import { read } from "./elements.mjs";

/** What the server says of the page; null where the page is a file. */
export const served = read("served");

/** The server's answer, below the page's address; with a `document` it is told that. Raises Error with its sentence. */
export async function ask(path, document) {
  const told = document === undefined ? {} : { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(document) };
  let answer;
  try {
    answer = await fetch(path, told);
  } catch {
    throw new Error("lslam view does not answer: it has ended");
  }
  const said = await answer.json();
  if (!answer.ok) throw new Error(said.error || answer.statusText);
  return said;
}
