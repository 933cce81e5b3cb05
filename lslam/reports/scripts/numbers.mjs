// Numbers: packed arrays, limits, text.

/** An array of `Kind` from base64; little-endian, as every machine with a browser is. */
export function unpack(text, Kind) {
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i += 1) bytes[i] = raw.charCodeAt(i);
  return new Kind(bytes.buffer);
}

export function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}

export function fixed(value, digits) {
  if (!Number.isFinite(value)) return "n/a";
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}

/** The scan whose value is nearest to `value`; -1 without one. */
export function nearestBy(values, value) {
  let best = -1;
  let least = Infinity;
  for (let k = 0; k < values.length; k += 1) {
    const off = Math.abs(values[k] - value);
    if (off < least) [least, best] = [off, k];
  }
  return best;
}

/** Round values within [low, high], about `wanted` of them. */
export function ticks(low, high, wanted) {
  const raw = (high - low) / wanted;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * power).reduce((a, b) => (Math.abs(Math.log(a / raw)) <= Math.abs(Math.log(b / raw)) ? a : b));
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i <= high / step + 1e-9; i += 1) found.push(i * step);
  return found;
}

/** A tick's number with the decimals that `span` asks for. */
export function number(value, span) {
  if (Math.abs(value) < 1e-9 * span) return "0";
  if (Math.abs(value) >= 1e6) return value.toPrecision(6);
  const text = value.toFixed(clamp(2 - Math.floor(Math.log10(span)), 0, 8));
  return (text.includes(".") ? text.replace(/\.?0+$/, "") : text).replace("-", "−");
}
