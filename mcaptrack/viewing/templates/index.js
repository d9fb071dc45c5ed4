"use strict";
const by = id => document.getElementById(id), data = JSON.parse(by("data").textContent);
const pages = new Map(Object.entries(data.pages).map(([name, address]) => ["page-" + name, address])); // by section
const frames = []; // the player of each view, once it was opened
let view = -1, at_s = data.at_s, wanted = {at_s};

function frame(address, title) {
  const made = document.createElement("iframe");
  made.title = title; made.src = address;
  made.sandbox = "allow-scripts allow-downloads"; // without an origin: what is in it reaches neither this page nor the log
  return made;
}
function open(tab) {
  for (const button of document.querySelectorAll("[role=tab]")) button.setAttribute("aria-selected", button.getAttribute("aria-controls") === tab);
  for (const name of ["player", ...pages.keys()]) by(name).hidden = name !== tab;
  if (tab !== "player" && !by(tab).firstChild) by(tab).append(frame(pages.get(tab), tab.slice(5)));
}
function look(number) { // show a view; it begins at the time that the one before showed
  const before = frames[view];
  view = number;
  for (const [k, button] of [...by("views").children].entries()) button.setAttribute("aria-pressed", k === number);
  if (before) before.hidden = true;
  wanted = {...wanted, at_s};
  if (!frames[number]) {
    by("waiting").hidden = false;
    frames[number] = frame(data.views[number].address, data.views[number].name);
    frames[number].addEventListener("load", () => { by("waiting").hidden = true; ask(number); });
    by("screen").append(frames[number]);
  } else { frames[number].hidden = false; ask(number); }
}
function ask(number) {
  if (number === view) frames[number].contentWindow.postMessage({show: wanted}, "*");
}
function go(second, tracks) {
  wanted = {at_s: second, tracks}; at_s = second;
  open("player");
  ask(view);
}
addEventListener("message", event => { // a player says which time it shows, a page which time was clicked
  if (frames[view] && event.source === frames[view].contentWindow && typeof event.data?.player?.at_s === "number") {
    at_s = event.data.player.at_s;
    highlight(); link();
  } else if ([...pages.keys()].some(name => event.source === by(name).firstChild?.contentWindow) && typeof event.data?.at_ns === "string" && /^-?\d{1,19}$/.test(event.data.at_ns))
    go(Number(BigInt(event.data.at_ns) - BigInt(data.start_ns)) / 1e9);
});
function link() { // other viewers open the log at the time that is shown, from the address of this page
  for (const viewer of document.querySelectorAll(".viewer[href]")) {
    const address = new URL(viewer.href), entries = [...address.searchParams];
    const t_ns = BigInt(data.start_ns) + BigInt(Math.round(at_s * 1e9)), at = new Date(Number(t_ns / 1000000000n) * 1000);
    address.search = new URLSearchParams(entries.map(([key, value]) => {
      if (key === "time" && at.getUTCFullYear() < 10000) value = at.toISOString().slice(0, 19) + "." + String(t_ns % 1000000000n).padStart(9, "0") + "Z";
      return [key, value.startsWith(data.root) ? location.origin + "/" + value.slice(data.root.length) : value];
    }));
    viewer.href = address.href;
  }
}
function list() {
  const shown = data.events.filter(event => by("which").value === "" || event.topic === by("which").value);
  by("events").replaceChildren(...shown.map(event => {
    const item = document.createElement("li"), button = document.createElement("button"), time = document.createElement("b"), text = document.createElement("span");
    time.textContent = `${event.at_s.toFixed(1)} s`; text.textContent = event.text;
    button.append(time, text); button.at_s = event.at_s;
    button.addEventListener("click", () => go(event.at_s, event.topic));
    item.append(button);
    return item;
  }));
  highlight();
}
function highlight() { // the last event of the two seconds before
  const buttons = [...by("events").querySelectorAll("button")], at = buttons.findLast(one => one.at_s <= at_s + 0.001 && one.at_s > at_s - 2);
  for (const button of buttons) button.classList.toggle("now", button === at);
}
for (const [k, one] of data.views.entries()) {
  const button = document.createElement("button");
  button.textContent = one.name;
  button.addEventListener("click", () => look(k));
  by("views").append(button);
}
by("views").hidden = data.views.length < 2;
const topics = [...new Set(data.events.map(event => event.topic))];
for (const topic of ["", ...topics]) by("which").append(new Option(topic || "all tracks", topic));
by("which").value = topics.includes(data.best) ? data.best : "";
by("which").hidden = topics.length < 2;
by("which").addEventListener("change", list);
for (const button of document.querySelectorAll("[role=tab]")) button.addEventListener("click", () => open(button.getAttribute("aria-controls")));
list(); link();
if (data.views.length) look(0); else by("waiting").textContent = "There are no pictures or tracks to show.";
