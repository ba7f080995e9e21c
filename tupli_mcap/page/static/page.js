// Scripts of all pages: local times, copying, embedding the viewer, the table and the player.

import { player } from "./player.js";
import { table } from "./table.js";
import { upload } from "./upload.js";

for (const time of document.querySelectorAll("time[datetime]")) {
  const moment = new Date(time.dateTime);
  if (!Number.isNaN(moment.valueOf())) {
    time.title = time.textContent;
    time.textContent = moment.toLocaleString(undefined, { dateStyle: "medium", timeStyle: "short" });
  }
}

for (const section of document.querySelectorAll(".player")) player(section);
for (const form of document.querySelectorAll("form.chosen")) table(form);
for (const form of document.querySelectorAll("form.drop")) upload(form);

document.addEventListener("submit", (event) => {
  const question = event.submitter?.dataset.sure;
  if (question && !confirm(question)) event.preventDefault();
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
    place.append(frame);
    place.scrollIntoView({ block: "nearest" });
  }
}
