// An episode step by step: a slider moves the pictures, the cursor in the tracks, and the values beside them.

const SVG = "http://www.w3.org/2000/svg";

export function player(section) {
  const slider = section.querySelector("input[type=range]");
  const output = section.querySelector(".transport output");
  const steps = Number(section.dataset.steps);
  const films = [...section.querySelectorAll("[data-camera]")].map(film);
  const cursor = cursorOver(section);
  const show = () => {
    const step = Number(slider.value);
    output.textContent = `step ${step} of ${steps}`;
    slider.setAttribute("aria-valuetext", output.textContent);
    for (const move of films) move(step);
    cursor(steps > 1 ? step / (steps - 1) : 0);
    values(section, step);
  };
  slider.addEventListener("input", show);
  slider.addEventListener("change", () => keep(section, slider.value));
  section.querySelector(".transport").addEventListener("submit", (event) => event.preventDefault());
  play(section, slider, steps, show);
  seekByTracks(section, slider, steps);
  addEventListener("resize", () => cursor(steps > 1 ? Number(slider.value) / (steps - 1) : 0));
  cursor(steps > 1 ? Number(slider.value) / (steps - 1) : 0);
  addEventListener("pageshow", () => {
    if (slider.value !== slider.defaultValue) show(); // a browser that goes back to a page restores its fields
  });
}

// Keeps the step in the address of an episode's page, for a reload, a bookmark, and who gets the address. Only of a slider
// that rests: a key that is held moves it more often than browsers let an address change.
let resting = null;
function keep(section, step) {
  if (location.pathname !== `/episode/${JSON.parse(section.dataset.episodes)[0][0]}`) return;
  clearTimeout(resting);
  resting = setTimeout(() => {
    const here = new URL(location.href);
    here.searchParams.set("step", step);
    history.replaceState(null, "", here);
  }, 200);
}

// Returns a function that shows the picture of a step. While one picture loads, only the last step asked for waits.
function film(image) {
  const shows = JSON.parse(image.dataset.shows); // the steps of the pictures, or their count if each step has one
  const base = image.getAttribute("src").replace(/\d+$/, "");
  let wanted = null;
  let busy = false;
  const alt = image.alt;
  const tell = () => (image.alt = image.naturalWidth ? alt : `${alt}: it cannot be read`);
  for (const name of ["load", "error"]) image.addEventListener(name, tell);
  if (image.complete) tell();
  const next = () => {
    if (wanted === null) return;
    const place = wanted;
    wanted = null;
    busy = true;
    const coming = new Image();
    coming.onload = coming.onerror = () => {
      image.src = base + place; // also if it cannot be loaded: that of another step would be wrong
      busy = false;
      next();
    };
    coming.src = base + place;
  };
  return (step) => {
    wanted = typeof shows === "number" ? Math.min(step, shows - 1) : lastUpTo(shows, step);
    if (!busy) next();
  };
}

function lastUpTo(shows, step) {
  let low = 0;
  let high = shows.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (shows[middle] <= step) low = middle;
    else high = middle - 1;
  }
  return low;
}

function cursorOver(section) {
  const tracks = section.querySelector(".tracks");
  const plot = tracks.querySelector(".row .plot");
  if (!plot) return () => {};
  const drawing = document.createElementNS(SVG, "svg");
  drawing.setAttribute("class", "cursor");
  drawing.setAttribute("aria-hidden", "true");
  const line = drawing.appendChild(document.createElementNS(SVG, "line"));
  line.setAttribute("y1", "0");
  line.setAttribute("y2", "100%");
  tracks.append(drawing);
  return (share) => {
    const outer = tracks.getBoundingClientRect();
    const inner = plot.getBoundingClientRect();
    drawing.style.left = `${inner.left - outer.left}px`;
    drawing.style.top = "0";
    drawing.style.width = `${inner.width}px`;
    drawing.style.height = `${outer.height}px`;
    for (const end of ["x1", "x2"]) line.setAttribute(end, `${100 * share}%`);
  };
}

function play(section, slider, steps, show) {
  const button = section.querySelector("[data-play]");
  const seconds = Number(section.dataset.seconds) || 1 / 30;
  const pace = Math.max(seconds, 8 / Math.max(8, steps) / 4, 1 / 60); // seconds a step: not faster than recorded, than 60 steps a second, or than the episode in 2 s
  let began = null;
  const frame = (now) => {
    if (began === null) return;
    const step = Math.min(steps - 1, began.step + Math.floor((now - began.time) / 1000 / pace));
    if (step !== Number(slider.value)) {
      slider.value = step;
      show();
    }
    if (step >= steps - 1) stop();
    else requestAnimationFrame(frame);
  };
  const stop = () => {
    if (began !== null) keep(section, slider.value);
    began = null;
    section.classList.remove("playing");
    button.setAttribute("aria-label", "Play");
  };
  button.addEventListener("click", () => {
    if (began !== null) return stop();
    const step = Number(slider.value) >= steps - 1 ? 0 : Number(slider.value);
    began = { step, time: performance.now() };
    section.classList.add("playing");
    button.setAttribute("aria-label", "Pause");
    requestAnimationFrame(frame);
  });
  for (const name of ["pointerdown", "input"]) slider.addEventListener(name, stop);
}

function seekByTracks(section, slider, steps) {
  const tracks = section.querySelector(".tracks");
  const seek = (event, ...told) => {
    const plot = event.target.closest(".plot");
    if (!plot) return;
    const box = plot.getBoundingClientRect();
    slider.value = Math.round(((event.clientX - box.left) / box.width) * (steps - 1));
    for (const name of told) slider.dispatchEvent(new Event(name));
  };
  tracks.addEventListener("click", (event) => seek(event, "input", "change"));
  // A mouse that is pressed on a curve drags the step, also beyond the curve; fingers scroll the page.
  const drags = (event) => event.pointerType === "mouse" && event.target.hasPointerCapture(event.pointerId);
  tracks.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "mouse" && event.button === 0) event.target.closest(".plot")?.setPointerCapture(event.pointerId);
  });
  tracks.addEventListener("pointermove", (event) => drags(event) && seek(event, "input"));
  tracks.addEventListener("pointerup", (event) => drags(event) && seek(event, "input", "change"));
}

// Fetches the values of the last step that was asked for, and skips steps that were passed meanwhile.
const asked = new WeakMap();
async function values(section, step) {
  const episodes = JSON.parse(section.dataset.episodes); // the id of each, and how many steps it has
  const busy = asked.has(section);
  asked.set(section, step);
  if (busy) return;
  while (true) {
    const now = asked.get(section);
    const told = await Promise.all(episodes.map(([id, steps]) => (now < steps ? valuesAt(id, now) : {})));
    for (const place of section.querySelectorAll("output[data-name]")) {
      const field = place.dataset.field ?? place.closest("[data-field]").dataset.field;
      const value = told[place.dataset.of ?? 0][field]?.[place.dataset.name] ?? "";
      const isNumber = /^-?(\d[\d.]*(e[-+]\d+)?|inf)$/.test(value);
      place.textContent = isNumber ? value.replaceAll("-", "\u2212") : value; // as all numbers of the page
    }
    if (asked.get(section) === now) break;
  }
  asked.delete(section);
}

// The values at a step; none if the server cannot be reached, or the user is not signed in any more.
async function valuesAt(episode, step) {
  try {
    const answer = await fetch(`/episode/${episode}/step/${step}`, { redirect: "error" });
    return answer.ok ? await answer.json() : {};
  } catch {
    return {};
  }
}
