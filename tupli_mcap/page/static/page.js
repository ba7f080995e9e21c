// Scripts of all pages: local times, copying, embedding the viewer, the table and the player.

import { player } from "./player.js";
import { table } from "./table.js";
import { upload } from "./upload.js";

for (const time of document.querySelectorAll("time[datetime]")) time.textContent = local(new Date(time.dateTime));

// The answer to a form is kept under the address of its page: to reload it sends no form again.
if (document.body.dataset.at) history.replaceState(null, "", document.body.dataset.at);

for (const section of document.querySelectorAll(".player")) player(section);
for (const form of document.querySelectorAll("form.chosen")) table(form);
for (const form of document.querySelectorAll("form.drop")) upload(form);

// A form that changes something is sent once, however often its button is pressed, unless the sending was stopped: by
// Escape, or else no page has come for ten seconds.
const sent = new Map(); // when (ms), by form
addEventListener("pageshow", () => sent.clear()); // back at a page whose form was sent
addEventListener("keydown", (event) => event.key === "Escape" && sent.clear());
document.addEventListener("submit", (event) => {
  const form = event.target;
  const question = event.submitter?.dataset.sure;
  const isUnderWay = performance.now() - sent.get(form) < 10_000;
  if (isUnderWay || (question && !confirm(question))) return event.preventDefault();
  if (form.method === "post") sent.set(form, performance.now());
});

document.addEventListener("click", (event) => {
  const button = event.target.closest("[data-copy]");
  if (button) copy(button);
  const opener = event.target.closest("[data-embed]");
  if (opener && !event.ctrlKey && !event.metaKey && !event.shiftKey) {
    event.preventDefault();
    embed(document.getElementById(opener.dataset.embed), opener);
  }
});

// A time in the zone of the browser, as tables of commands show it: 2026-11-23 04:31:07+01:00.
function local(moment) {
  const ahead = -moment.getTimezoneOffset(); // minutes
  const [day, clock] = new Date(moment.valueOf() + 60_000 * ahead).toISOString().split("T");
  const zone = [Math.abs(ahead) / 60, Math.abs(ahead) % 60].map((part) => String(Math.trunc(part)).padStart(2, "0"));
  return `${day} ${clock.slice(0, 8)}${ahead < 0 ? "-" : "+"}${zone.join(":")}`;
}

async function copy(button) {
  const label = (button.dataset.label ??= button.textContent);
  try {
    await navigator.clipboard.writeText(button.dataset.copy);
    button.textContent = "Copied";
  } catch {
    prompt("Copy this:", button.dataset.copy); // browsers allow the clipboard only to pages from HTTPS or from this machine
  }
  setTimeout(() => (button.textContent = label), 1500);
}

// Shows a page within this one, or removes it if it is shown.
function embed(place, opener) {
  const gone = place.hidden;
  place.hidden = !gone;
  place.replaceChildren();
  opener.setAttribute("aria-expanded", String(gone));
  if (gone) {
    const frame = document.createElement("iframe");
    frame.src = opener.href;
    frame.title = "Replay in the Rerun viewer";
    // A page that may not be framed, such as the sign-in, is shown in place of this one.
    frame.addEventListener("load", () => frame.contentDocument || location.assign(opener.href));
    place.append(frame);
    place.scrollIntoView({ block: "nearest" });
  }
}
