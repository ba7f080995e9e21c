// A table of episodes: the selection, its buttons, and a small line in each row.

const SVG = "http://www.w3.org/2000/svg";

export function table(form) {
  const boxes = [...form.querySelectorAll("input[type=checkbox][name=episode]")];
  const here = new Set(boxes.map((box) => box.value));
  const all = form.querySelector("[data-all]");
  const none = form.querySelector("[data-none]");
  const count = form.querySelector("[data-count]");
  const told = count.textContent;
  const python = form.querySelector("[data-python]");
  const [most, mostDownloaded] = ["/compare", "/download"].map((to) => Number(form.querySelector(`[formaction="${to}"]`).dataset.most));
  // The address keeps the selection, and so do links to other pages of the table, other orders and other filters. What is
  // no id is left out: an address may be anybody's, and the ids become Python code that users run.
  const kept = new URLSearchParams(location.search).getAll("episode").filter((id) => /^[0-9a-f]{32}-\d+$/.test(id));
  let elsewhere = kept.filter((id) => !here.has(id));
  for (const box of boxes) box.checked ||= kept.includes(box.value);
  const chosen = () => [...elsewhere, ...boxes.filter((box) => box.checked).map((box) => box.value)];
  const show = () => {
    const ids = chosen();
    const number = ids.length;
    for (const button of form.querySelectorAll("[data-least]")) {
      button.disabled = number < Number(button.dataset.least) || number > Number(button.dataset.most ?? Infinity);
    }
    const others = elsewhere.length ? `, ${elsewhere.length} of them not on this page` : "";
    const excess = number > most ? `; at most ${most} can be compared` : "";
    const tooMany = number > mostDownloaded ? `, and ${mostDownloaded.toLocaleString("en")} downloaded: filter, and download all` : "";
    count.textContent = number ? `${number} selected${others}${excess}${tooMany}` : told;
    none.hidden = !number;
    const checked = number - elsewhere.length;
    all.checked = checked === boxes.length;
    all.indeterminate = checked > 0 && checked < boxes.length;
    python.dataset.copy = `tupli_mcap.open(${JSON.stringify(form.dataset.open)}).filter('id in [${ids.map((id) => `"${id}"`).join(", ")}]')`;
    hide(form, elsewhere);
    for (const filter of document.querySelectorAll("form.filter")) hide(filter, ids);
    for (const link of document.querySelectorAll(".pages a, thead a, .filter a")) link.href = withChosen(link.href, ids);
    if (String(ids) !== String(new URLSearchParams(location.search).getAll("episode"))) history.replaceState(null, "", withChosen(location.href, ids));
  };
  all.hidden = false;
  all.addEventListener("change", () => {
    for (const box of boxes) box.checked = all.checked;
    show();
  });
  none.addEventListener("click", () => {
    elsewhere = [];
    for (const box of boxes) box.checked = false;
    show();
    all.focus();
  });
  form.addEventListener("change", show);
  addEventListener("pageshow", show);
  show();
  sparks(form);
}

function withChosen(address, ids) {
  const url = new URL(address);
  url.searchParams.delete("episode");
  for (const id of ids) url.searchParams.append("episode", id);
  return url.href;
}

// Lets a form send the ids of episodes that it does not show.
function hide(form, ids) {
  for (const field of form.querySelectorAll("input[type=hidden][name=episode]")) field.remove();
  for (const id of ids) form.append(Object.assign(document.createElement("input"), { type: "hidden", name: "episode", value: id }));
}

async function sparks(form) {
  const cells = [...form.querySelectorAll("td.spark")];
  if (!cells.length) return;
  const query = new URLSearchParams(cells.map((cell) => ["episode", cell.dataset.episode]));
  const answer = await fetch(`/sparks?${query}`).catch(() => null);
  if (!answer?.ok) return;
  const { name, lines } = await answer.json();
  form.querySelector("[data-spark-name]").textContent = name;
  for (const cell of cells) {
    const line = lines[cell.dataset.episode];
    if (!line) continue;
    const drawing = document.createElementNS(SVG, "svg");
    drawing.setAttribute("viewBox", "0 -8 1000 116");
    drawing.setAttribute("preserveAspectRatio", "none");
    drawing.setAttribute("aria-hidden", "true");
    const path = drawing.appendChild(document.createElementNS(SVG, "path"));
    path.setAttribute("class", "line s0");
    path.setAttribute("d", line);
    cell.append(drawing);
  }
}
