// The page: asks its server what to show, again whenever the server says that there is something new.

import { look, plan, stamp, strips } from "./charts.js";

const $ = (id) => document.getElementById(id);
const state = {
  about: null, span: [0, 0], view: "", selected: null,
  found: { tracks: [], live: null, ais: [] }, detections: { time: [], azimuth_deg: [], range_m: [] }, maps: { time: [], strips: {} },
};

// A station rewrites its status every minute.
const SILENT_S = 300;

const clock = (seconds) => stamp(seconds).slice(11, 16);
const day = (seconds) => stamp(seconds).slice(0, 10);
const finite = (value) => value !== null && value !== undefined;

function node(name, text, attributes = {}) {
  const made = document.createElement(name);
  if (text !== undefined) made.textContent = text;
  Object.entries(attributes).forEach(([key, value]) => made.setAttribute(key, value));
  return made;
}

async function ask(what, query = {}) {
  const answer = await fetch(`/api/${what}?${new URLSearchParams(query)}`);
  const value = await answer.json();
  if (!answer.ok) throw new Error(value.error || answer.statusText);
  return value;
}

// ---- time range ----

function span() {
  const chosen = document.querySelector('input[name="range"]:checked').value, [first, last] = state.about.span;
  if (chosen === "all") return [first - 60, last + 60];
  if (chosen !== "own") return [last - 3600 * Number(chosen), last + 60];
  const [from, to] = ["from", "to"].map((id) => Date.parse(`${$(id).value}Z`) / 1000);
  return from < to ? [from, to] : [first - 60, last + 60];
}

function startRanges() {
  document.querySelectorAll('input[name="range"]').forEach((input) => input.addEventListener("change", () => {
    const own = input.value === "own";
    $("own").hidden = !own;
    if (own && !$("from").value) {
      $("from").value = stamp(state.span[0]).slice(0, 16);
      $("to").value = stamp(state.span[1]).slice(0, 16);
    }
    show();
  }));
  ["from", "to"].forEach((id) => $(id).addEventListener("change", show));
}

// ---- words and numbers ----

function head() {
  const { about } = state, station = about.station;
  $("station").textContent = station.code;
  document.title = `${station.code} – obsnet`;
  const degrees = (value, marks) => `${Math.abs(value).toFixed(4)}° ${marks[value < 0 ? 1 : 0]}`;
  $("place").textContent = finite(station.latitude)
    ? `${degrees(station.latitude, "NS")}, ${degrees(station.longitude, "EW")} · ${Math.round(station.depth_m)} m deep` : "";
  $("version").textContent = about.obsnet;
  const last = about.span[1] > 60 ? `${day(about.span[1])} ${clock(about.span[1])} UTC` : "no minute yet";
  const told = about.status_time ? Date.parse(about.status_time) / 1000 : null;
  if (!about.healthy || about.trouble) tell("bad", about.trouble || "not healthy");
  else if (told && Date.now() / 1000 - told > SILENT_S) tell("bad", `no word from the station since ${day(told)} ${clock(told)} UTC`);
  else if (about.kind === "live") tell("well", `live · last minute ${last}`);
  else tell("", `finished run · until ${last}`);
  $("health").replaceChildren(...Object.entries(about.health).map(([name, value]) => {
    const row = node("div");
    row.append(node("dt", name), node("dd", String(value)));
    return row;
  }));
  $("files").replaceChildren(...about.files.map((name) => {
    const item = node("li");
    item.append(node("a", name, { href: `/files/${encodeURIComponent(name)}`, download: name }));
    return item;
  }));
}

function tell(kind, text) {
  $("state").dataset.state = kind;
  if ($("state").textContent !== text) $("state").textContent = text;
}

function list() {
  const tracks = [...state.found.tracks].reverse();
  $("none").hidden = tracks.length > 0;
  if (!tracks.some((track) => track.track === state.selected)) state.selected = null;
  const focused = document.activeElement && document.activeElement.dataset.track;
  const entry = state.selected ?? (tracks.length ? tracks[0].track : null);
  $("tracks").replaceChildren(...tracks.map((track) => {
    const chosen = track.track === state.selected, km = (track.cpa_distance_m / 1000).toFixed(1);
    const item = node("li", undefined, { role: "option", "aria-selected": chosen, tabindex: track.track === entry ? 0 : -1, id: `track-${track.track}`, "data-track": track.track });
    const badge = node("span", String(track.track), { class: "badge" });
    badge.style.borderColor = look(track.track).color;
    const when = node("span", `${day(track.span[0])} ${clock(track.span[0])}–${clock(track.span[1])}`);
    when.append(node("small", `nearest ${track.cpa_time.slice(11, 16)} UTC${finite(track.course_deg) ? `, course ${track.course_deg.toFixed(0)}°` : ""}`));
    const far = node("span", `${km} km`, { class: "far" });
    far.append(node("small", `${(track.speed_mps * 1.94384).toFixed(1)} kn`));
    item.append(badge, when, far);
    item.addEventListener("click", () => select(track.track));
    return item;
  }));
  if (focused) $(`track-${focused}`)?.focus();
}

function keys(event) {
  const items = [...$("tracks").children], here = items.indexOf(document.activeElement);
  if (here < 0) return;
  const to = { ArrowDown: here + 1, ArrowUp: here - 1, Home: 0, End: items.length - 1 }[event.key];
  if (to !== undefined) {
    const item = items[Math.min(Math.max(to, 0), items.length - 1)];
    select(Number(item.dataset.track));
    $(item.id).focus();
  } else if (event.key === "Enter" || event.key === " ") select(Number(items[here].dataset.track));
  else if (event.key === "Escape") select(null);
  else return;
  event.preventDefault();
}

function details() {
  const track = state.found.tracks.find((t) => t.track === state.selected);
  if (!track) {
    $("details").replaceChildren(...(state.found.tracks.length ? [node("p", "Choose a ship: click it, or use the arrow keys.", { class: "quiet" })] : []));
    return;
  }
  const pm = (value, error, digits, unit, scale = 1) => {
    const cell = node("dd", finite(value) ? `${(value * scale).toFixed(digits)}` : "not observed");
    if (finite(value) && finite(error)) cell.append(node("span", ` ± ${(error * scale).toFixed(digits)}`, { class: "pm" }));
    if (finite(value)) cell.append(` ${unit}`);
    return cell;
  };
  const rows = [
    ["heard", node("dd", `${track.start.slice(0, 16).replace("T", " ")} to ${track.end.slice(11, 16)}`)],
    ["closest (CPA)", node("dd", `${track.cpa_time.slice(11, 19)} ± ${Math.round(track.cpa_time_std_s)} s`)],
    ["CPA distance", pm(track.cpa_distance_m, track.cpa_distance_std_m, 2, "km", 0.001)],
    ["CPA azimuth", pm(track.cpa_azimuth_deg, null, 1, "°")],
    ["course", pm(track.course_deg, track.course_std_deg, 1, "°")],
    ["speed", pm(track.speed_mps, track.speed_std_mps, 2, "m/s")],
    ["", pm(track.speed_mps, track.speed_std_mps, 1, "kn", 1.94384)],
    ["log Bayes factor", pm(track.log_bayes_factor, null, 0, "")],
  ];
  const table = node("dl");
  rows.forEach(([name, cell]) => table.append(node("dt", name), cell));
  $("details").replaceChildren(node("h3", `Ship ${track.track}`), table);
}

function now() {
  const { live } = state.found, last = live && live.now;
  $("now").hidden = !live;
  if (!live) return;
  const said = [
    finite(last.azimuth_deg) && `azimuth ${last.azimuth_deg.toFixed(0)} ± ${last.azimuth_std_deg.toFixed(0)}°`,
    finite(last.range_m) && `range ${(last.range_m / 1000).toFixed(1)} ± ${(last.range_std_m / 1000).toFixed(1)} km`,
    finite(last.course_deg) && `course ${last.course_deg.toFixed(0)}°`,
    finite(last.speed_mps) && `${(last.speed_mps * 1.94384).toFixed(1)} kn`,
  ].filter(Boolean).join(", ");
  $("now").replaceChildren(node("strong", `Heard at ${last.time.slice(11, 16)} UTC (probability ${last.existence.toFixed(2)})`), said);
}

function legend() {
  const mark = (drawn) => `<svg width="26" height="10" aria-hidden="true">${drawn}</svg>`;
  const parts = [
    ['<path d="M1 5H25" stroke="#D55E00" stroke-width="3"/>', "track, 90 % band, ellipse at CPA"],
    ['<circle cx="8" cy="5" r="3" fill="#6276ba"/><circle cx="18" cy="5" r="3" fill="#b25652"/>', "detections, coloured by azimuth as the ring"],
  ];
  if (state.found.ais.length) parts.push(['<path d="M1 5H25" stroke="#3b4a52" stroke-width="2" stroke-dasharray="5 3"/>', "AIS"]);
  if (state.found.live) parts.push(['<path d="M13 0 18 5 13 10 8 5Z" fill="#E69F00" stroke="#16262f"/>', "heard now"]);
  $("plan-key").replaceChildren(...parts.map(([drawn, text]) => {
    const item = node("span");
    item.innerHTML = mark(drawn);
    item.append(text);
    return item;
  }));
}

function select(number) {
  state.selected = number;
  list();
  details();
  draw();
}

function draw() {
  plan($("plan"), state, select);
  strips($("strips"), state, select);
}

// ---- asking ----

let asking = null;

async function show() {
  const mine = {};
  asking = mine;
  try {
    const about = await ask("about");
    state.about = about;
    const wanted = span(), query = { start: Math.max(wanted[0], 0), end: wanted[1] };
    const wide = Math.min(1440, Math.max(240, $("strips").clientWidth));
    const [found, detections, maps] = await Promise.all([ask("tracks", query), ask("detections", query), ask("strips", { ...query, columns: wide })]);
    if (asking !== mine) return;
    Object.assign(state, { span: wanted, found, detections, maps, view: document.querySelector('input[name="range"]:checked').value });
    head();
    now();
    list();
    details();
    legend();
    $("no-strips").hidden = Object.keys(maps.strips).length > 0;
    draw();
    document.body.dataset.shown = about.stamp;
  } catch (error) {
    tell("bad", `cannot read: ${error.message}`);
  }
}

function follow() {
  const events = new EventSource("/api/events");
  events.onmessage = (event) => {
    if (!state.about || JSON.parse(event.data).stamp !== state.about.stamp) show();
    else head();
  };
  events.onerror = () => tell("bad", "connection lost; trying again");
}

window.addEventListener("DOMContentLoaded", () => {
  startRanges();
  $("tracks").addEventListener("keydown", keys);
  window.matchMedia("(max-width: 820px)").addEventListener("change", () => state.about && draw());
  show().then(follow);
});
