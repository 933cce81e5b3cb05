// A drive in an old map: which parts of its trajectory the map holds, and which odometry carries.

/**
 * Parts of a trajectory by the style of its scans: x, y, z of each scan, NaN elsewhere. Each part reaches to the next scan.
 * codes : the state of each scan; states : [words, style] of each code
 */
export function partsOf(positions, codes, states) {
  const styles = [...new Set(Array.from(codes, (code) => states[code][1]))];
  return styles.map((style) => {
    const points = positions.slice();
    for (let k = 0; k < codes.length; k += 1) {
      const isOwn = states[codes[k]][1] === style || (k > 0 && states[codes[k - 1]][1] === style);
      if (!isOwn) points.fill(NaN, 3 * k, 3 * k + 3);
    }
    return { style, points };
  });
}
