// The two charts: the plan view and the strips against time. Plotly draws; nothing is fetched here.

// Okabe and Ito, each told apart by its dashes too; cyclic colours (twilight) stand for azimuth.
const COLOURS = ["#D55E00", "#0072B2", "#CC79A7", "#009E73", "#B8860B"];
const DASHES = ["solid", "dashdot", "dot", "longdash"];
const CYCLIC = [
  "#e2d9e2", "#c4ced4", "#95b5c7", "#7297c1", "#6276ba", "#5e51ad", "#592a8f", "#45135c", "#2f1436",
  "#4a1342", "#741e4f", "#983550", "#b25652", "#c27c63", "#cca389", "#d8c7be", "#e2d9e2",
].map((colour, i) => [i / 16, colour]);
const INK = "#16262f", SOFT = "#51636d", LINE = "#d5dde1";
const FONT = { family: 'system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif', size: 12, color: INK };
const CONFIG = { displayModeBar: false, responsive: true, doubleClick: "reset" };

export const look = (number) => ({
  color: COLOURS[(number - 1) % COLOURS.length],
  dash: DASHES[Math.floor((number - 1) / COLOURS.length) % DASHES.length],
});

// Plotly takes text without a zone as it stands: UTC.
export const stamp = (seconds) => new Date(seconds * 1000).toISOString().slice(0, 19);

const narrow = () => window.matchMedia("(max-width: 820px)").matches;
const alpha = (hex, a) => `rgba(${[1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16)).join(",")},${a})`;

// ---- plan view ----

function reach(tracks, live, ships) {
  const far = [];
  const add = (shape) => shape && shape.east_km && shape.east_km.forEach((e, i) => {
    if (e !== null) far.push(Math.hypot(e, shape.north_km[i]));
  });
  tracks.forEach((track) => (track.shape.east_km ? add(track.shape) : far.push(track.cpa_distance_m / 500)));
  if (live) add(live.trail);
  if (!far.length) ships.forEach(add);
  return Math.min(Math.max(1.12 * Math.max(5, ...far), 5), 110);
}

function compass(radius) {
  const azimuth = [...Array(361).keys()], turn = azimuth.map((a) => (a * Math.PI) / 180);
  return {
    x: turn.map((a) => radius * Math.sin(a)), y: turn.map((a) => radius * Math.cos(a)), mode: "markers", hoverinfo: "skip",
    marker: { size: 5, color: azimuth, colorscale: CYCLIC, cmin: 0, cmax: 360 }, showlegend: false,
  };
}

function rings(limit) {
  const step = [1, 2, 5, 10, 20, 25, 50].find((s) => limit / s < 5.5) || 50;
  const shapes = [], notes = [];
  for (let r = step; r < 0.97 * limit; r += step) {
    shapes.push({ type: "circle", x0: -r, x1: r, y0: -r, y1: r, line: { color: LINE, width: 1 }, layer: "below" });
    notes.push({ x: r * Math.SQRT1_2, y: -r * Math.SQRT1_2, text: `${r} km`, showarrow: false, font: { size: 10, color: SOFT }, bgcolor: "#fff", borderpad: 1 });
  }
  [["N", 0, 1], ["E", 1, 0], ["S", 0, -1], ["W", -1, 0]].forEach(([text, x, y]) =>
    notes.push({ x: 1.075 * limit * x, y: 1.075 * limit * y, text, showarrow: false, font: { size: 13, color: INK } }));
  return { shapes, notes };
}

export function plan(element, state, select) {
  const { tracks, live, ais: ships } = state.found, limit = reach(tracks, live, ships);
  const { shapes, notes } = rings(limit);
  const traces = [compass(limit)];
  const detections = state.detections, x = [], y = [], azimuths = [];
  detections.time.forEach((_, i) => {
    const azimuth = detections.azimuth_deg[i], range = detections.range_m[i];
    if (azimuth === null || range === null) return;
    x.push((range / 1000) * Math.sin((azimuth * Math.PI) / 180));
    y.push((range / 1000) * Math.cos((azimuth * Math.PI) / 180));
    azimuths.push(azimuth);
  });
  traces.push({ x, y, mode: "markers", hoverinfo: "skip", marker: { size: 3.5, color: azimuths, colorscale: CYCLIC, cmin: 0, cmax: 360, opacity: 0.75 } });
  ships.forEach((ship) => traces.push({
    x: ship.east_km, y: ship.north_km, mode: "lines", line: { color: "#3b4a52", width: 1.5, dash: "dash" },
    text: ship.time.map((t) => `AIS ${ship.name || ship.mmsi}<br>${stamp(t).replace("T", " ")}`), hoverinfo: "text",
  }));
  tracks.forEach((track) => {
    const { color, dash } = look(track.track), shape = track.shape, chosen = track.track === state.selected;
    const dim = state.selected !== null && !chosen;
    const common = { customdata: [track.track], hoverinfo: "skip", mode: "lines" };
    if (!shape.east_km) {
      const turn = [...Array(91).keys()].map((i) => (i * 4 * Math.PI) / 180), r = track.cpa_distance_m / 1000;
      traces.push({ ...common, x: turn.map((a) => r * Math.sin(a)), y: turn.map((a) => r * Math.cos(a)), line: { color, width: 2, dash: "dot" }, customdata: turn.map(() => track.track) });
      return;
    }
    if (shape.band) {
      traces.push({ ...common, x: shape.band[0], y: shape.band[1], fill: "toself", fillcolor: alpha(color, dim ? 0.08 : 0.2), line: { width: 0 } });
      traces.push({ ...common, x: shape.ellipse[0], y: shape.ellipse[1], fill: "toself", fillcolor: alpha(color, 0.35), line: { color: INK, width: 1 } });
    }
    traces.push({
      x: shape.east_km, y: shape.north_km, mode: "lines", line: { color: dim ? alpha(color, 0.45) : color, width: chosen ? 4.5 : 2.5, dash },
      customdata: shape.time.map(() => track.track), text: shape.time.map((t) => `ship ${track.track}<br>${stamp(t).replace("T", " ")}`), hoverinfo: "text",
    });
    const last = shape.east_km.length - 1;
    traces.push({
      x: [shape.east_km[last]], y: [shape.north_km[last]], mode: "markers+text", text: [String(track.track)], customdata: [track.track], hoverinfo: "skip",
      marker: { size: 19, color: "#fff", line: { color, width: 2.5 } }, textfont: { size: 11, color: INK }, cliponaxis: false,
    });
  });
  if (live) {
    traces.push({ x: live.trail.east_km, y: live.trail.north_km, mode: "lines", line: { color: INK, width: 1.5 }, hoverinfo: "skip" });
    if (live.ellipse) traces.push({ x: live.ellipse[0], y: live.ellipse[1], mode: "lines", fill: "toself", fillcolor: "rgba(230,159,0,.35)", line: { color: INK, width: 1 }, hoverinfo: "skip" });
    const end = live.trail.time.length - 1;
    traces.push({ x: [live.trail.east_km[end]], y: [live.trail.north_km[end]], mode: "markers", marker: { symbol: "diamond", size: 13, color: "#E69F00", line: { color: INK, width: 1.5 } }, text: ["heard now"], hoverinfo: "text" });
  }
  traces.push({ x: [0], y: [0], mode: "markers", marker: { symbol: "triangle-down", size: 13, color: "#F0E442", line: { color: INK, width: 1.5 } }, text: ["station"], hoverinfo: "text" });
  const axis = { range: [-1.14 * limit, 1.14 * limit], zeroline: false, showgrid: false, ticks: "outside", tickcolor: LINE, nticks: 7, constrain: "domain", fixedrange: narrow() };
  const layout = {
    showlegend: false, margin: { l: 46, r: 8, t: 6, b: 40 }, font: FONT, shapes, annotations: notes, hovermode: "closest", dragmode: narrow() ? false : "pan",
    xaxis: { ...axis, title: { text: "east [km]", standoff: 6 } }, yaxis: { ...axis, title: { text: "north [km]", standoff: 2 }, scaleanchor: "x" },
    paper_bgcolor: "#fff", plot_bgcolor: "#fff", uirevision: state.view,
  };
  Plotly.react(element, traces, layout, { ...CONFIG, scrollZoom: !narrow() });
  listen(element, (point) => trackAt(point, tracks, limit), select);
  const said = tracks.map((t) => `ship ${t.track} nearest at ${(t.cpa_distance_m / 1000).toFixed(1)} km`).join(", ");
  element.setAttribute("aria-label", `Plan view around the station: ${tracks.length ? said : "no track"}${live ? "; a ship is heard now" : ""}`);
}

// The track of a point that was clicked: its own, or the nearest where the point is of an AIS ship over it.
function trackAt(point, tracks, limit) {
  if (typeof point.customdata === "number") return point.customdata;
  let best = [0.04 * limit, null];
  tracks.forEach(({ track, shape }) => (shape.east_km || []).forEach((east, i) => {
    const away = Math.hypot(east - point.x, shape.north_km[i] - point.y);
    if (away < best[0]) best = [away, track];
  }));
  return best[1];
}

function listen(element, find, select) {
  element.removeAllListeners("plotly_click");
  element.on("plotly_click", (event) => {
    const number = event.points.map(find).find((found) => found !== null && found !== undefined);
    if (number !== undefined) select(number);
  });
}

// ---- strips ----

function decode(strip, columns) {
  const bytes = Uint8Array.from(atob(strip.bytes), (c) => c.charCodeAt(0));
  const scale = (strip.high - strip.low) / 254, rows = [];
  for (let cell = 0; cell < strip.count; cell += 1) {
    const row = new Array(columns);
    for (let i = 0; i < columns; i += 1) {
      const byte = bytes[cell * columns + i];
      row[i] = byte ? strip.low + (byte - 1) * scale : null;
    }
    rows.push(row);
  }
  return rows;
}

// A column far from the next one is followed by an empty one: a gap is white.
function withGaps(times, rows) {
  const gaps = times.slice(1).map((t, i) => t - times[i]).sort((a, b) => a - b);
  const step = gaps.length ? gaps[Math.floor(gaps.length / 2)] : 60;
  const at = [];
  times.forEach((t, i) => {
    if (i && t - times[i - 1] > 1.5 * step) at.push([times[i - 1] + step, null], [t - step, null]);
    at.push([t, i]);
  });
  return [at.map(([t]) => stamp(t)), rows.map((row) => at.map(([, i]) => (i === null ? null : row[i])))];
}

function heat(name, axis, data, scale, colorscale, span, bar) {
  const strip = data.strips[name];
  const [x, z] = withGaps(data.time, decode(strip, data.time.length));
  const y = [...Array(strip.count).keys()].map((i) => (strip.first + i * strip.step) * scale);
  return {
    type: "heatmap", x, y, z, yaxis: axis, colorscale, zmin: span[0], zmax: span[1], zsmooth: false, hoverongaps: false,
    hovertemplate: `%{x|%H:%M}<br>%{y:.4g}<br>%{z:.3g} ${strip.of === "log-likelihood ratio" ? "nats" : "dB"}<extra></extra>`,
    colorbar: { ...bar, thickness: 9, outlinewidth: 0, tickfont: { size: 10 }, len: 0.28, ticklen: 3, title: { text: bar.name, side: "right", font: { size: 11 } } },
    showscale: !narrow(),
  };
}

function levels(data) {
  const strip = data.strips.spectrum, bytes = atob(strip.bytes), seen = [];
  for (let i = 0; i < bytes.length; i += 7) if (bytes.charCodeAt(i)) seen.push(bytes.charCodeAt(i));
  seen.sort((a, b) => a - b);
  const at = (q) => strip.low + (((seen[Math.floor(q * (seen.length - 1))] || 1) - 1) * (strip.high - strip.low)) / 254;
  return [at(0.05), at(0.99)];
}

export function strips(element, state, select) {
  const { maps, detections, found } = state, traces = [], has = maps.strips;
  const domains = { azimuth: [0.7, 1], range: [0.35, 0.65], spectrum: [0, 0.3] };
  const bar = (name, text) => ({ y: (domains[name][0] + domains[name][1]) / 2, name: text });
  if (has.azimuth) traces.push(heat("azimuth", "y", maps, 1, "Cividis", [-10, 25], bar("azimuth", "nats")));
  if (has.range) traces.push(heat("range", "y2", maps, 0.001, "Cividis", [-10, 25], bar("range", "nats")));
  if (has.spectrum) traces.push(heat("spectrum", "y3", maps, 1, "Cividis", levels(maps), bar("spectrum", "dB")));
  const time = detections.time.map(stamp), dots = { mode: "markers", hoverinfo: "skip" };
  traces.push({ ...dots, x: time, y: detections.azimuth_deg, yaxis: "y", marker: { size: 4, color: detections.azimuth_deg, colorscale: CYCLIC, cmin: 0, cmax: 360, line: { color: "#fff", width: 0.5 } } });
  traces.push({ ...dots, x: time, y: detections.range_m.map((r) => (r === null ? null : r / 1000)), yaxis: "y2", marker: { size: 4, color: detections.azimuth_deg.map((a) => (a === null ? 0 : a)), colorscale: CYCLIC, cmin: 0, cmax: 360, line: { color: "#fff", width: 0.5 } } });
  found.ais.forEach((ship) => {
    const line = { x: ship.time.map(stamp), mode: "lines", line: { color: "#fff", width: 1, dash: "dot" }, text: ship.time.map(() => `AIS ${ship.name || ship.mmsi}`), hoverinfo: "text" };
    traces.push({ ...line, y: unwrapped(ship.azimuth_deg), yaxis: "y" }, { ...line, y: ship.range_km, yaxis: "y2" });
  });
  found.tracks.forEach((track) => {
    const { color, dash } = look(track.track), shape = track.shape, width = track.track === state.selected ? 4 : 2;
    [["azimuth_deg", "y"], ["range_km", "y2"]].forEach(([name, yaxis]) => {
      if (!shape[name]) return;
      const line = { x: shape.time.map(stamp), y: name === "azimuth_deg" ? unwrapped(shape[name]) : shape[name], yaxis, mode: "lines", customdata: shape.time.map(() => track.track) };
      traces.push({ ...line, line: { color: "rgba(255,255,255,.85)", width: width + 2.5 }, hoverinfo: "skip" });
      traces.push({ ...line, line: { color, width, dash }, text: shape.time.map(() => `ship ${track.track}`), hoverinfo: "text" });
    });
  });
  const y = { zeroline: false, gridcolor: "#eef2f4", ticks: "outside", tickcolor: LINE, fixedrange: true, titlefont: { size: 12 } };
  const layout = {
    showlegend: false, font: FONT, margin: { l: narrow() ? 50 : 66, r: narrow() ? 8 : 70, t: 8, b: 52 }, hovermode: "closest", dragmode: narrow() ? false : "zoom",
    xaxis: { type: "date", range: state.span.map(stamp), anchor: "y3", gridcolor: "#eef2f4", tickformatstops: [{ dtickrange: [null, 86400000 - 1], value: "%H:%M\n%d %b %Y" }, { dtickrange: [86400000, null], value: "%d %b\n%Y" }], nticks: narrow() ? 5 : 12, fixedrange: narrow() },
    yaxis: { ...y, domain: domains.azimuth, range: [0, 360], tickvals: [0, 90, 180, 270, 360], ticktext: ["N", "E", "S", "W", "N"], title: { text: "azimuth", standoff: 8 } },
    yaxis2: { ...y, domain: domains.range, rangemode: "tozero", autorange: has.range ? false : true, ...(has.range ? { range: [0, top(has.range)] } : {}), title: { text: "range [km]", standoff: 8 } },
    yaxis3: { ...y, domain: domains.spectrum, ...(has.spectrum ? { range: [0, has.spectrum.first + has.spectrum.step * has.spectrum.count] } : { range: [0, 25] }), title: { text: "frequency [Hz]", standoff: 8 } },
    paper_bgcolor: "#fff", plot_bgcolor: "#f6f8f9", uirevision: state.view,
  };
  Plotly.react(element, traces, layout, CONFIG);
  listen(element, (point) => (typeof point.customdata === "number" ? point.customdata : null), select);
}

const top = (strip) => ((strip.first + strip.step * strip.count) / 1000);

// A line that passes North is broken there instead of crossing the chart.
function unwrapped(azimuths) {
  return azimuths.map((a, i) => (i && a !== null && azimuths[i - 1] !== null && Math.abs(a - azimuths[i - 1]) > 180 ? null : a));
}
