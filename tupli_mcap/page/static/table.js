// A table of episodes: the selection, its buttons, and a small line in each row.

const SVG = "http://www.w3.org/2000/svg";

export function table(form) {
  const boxes = [...form.querySelectorAll("input[name=episode]")];
  const all = form.querySelector("[data-all]");
  const count = form.querySelector("[data-count]");
  const told = count.textContent;
  const python = form.querySelector("[data-python]");
  const most = Number(form.querySelector("[data-most]").dataset.most);
  const chosen = () => boxes.filter((box) => box.checked).map((box) => box.value);
  const show = () => {
    const number = chosen().length;
    for (const button of form.querySelectorAll("[data-least]")) {
      button.disabled = number < Number(button.dataset.least) || number > Number(button.dataset.most ?? Infinity);
    }
    count.textContent = number > most ? `${number} selected; at most ${most} can be compared` : number ? `${number} selected` : told;
    all.checked = number === boxes.length;
    all.indeterminate = number > 0 && number < boxes.length;
    const ids = chosen().map((id) => `"${id}"`);
    python.dataset.copy = `tupli_mcap.open(${JSON.stringify(form.dataset.open)}).filter('id in [${ids.join(", ")}]')`;
  };
  all.hidden = false;
  all.addEventListener("change", () => {
    for (const box of boxes) box.checked = all.checked;
    show();
  });
  form.addEventListener("change", show);
  addEventListener("pageshow", show);
  show();
  sparks(form);
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
