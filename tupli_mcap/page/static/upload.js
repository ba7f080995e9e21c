// Uploads recordings that are dropped on the page (protocol tus). Skips what the server has; continues what was interrupted.

const PIECE = 16 << 20;
const TRIES = 5;
const LATER = [423, 429, 500, 502, 503, 504]; // the server cannot answer now
const GONE = 410; // the upload has ended, as by another page that has sent the same file: ask what is there now

export function upload(form) {
  const list = document.querySelector(".uploads");
  let turn = Promise.resolve();
  let coming = 0;
  const begin = (file, row) => {
    coming++;
    const again = () => begin(file, row);
    turn = turn.then(() => send(form, file, row)).catch((error) => row.fail(error, again)).finally(() => coming--);
  };
  const take = (files) => {
    for (const file of files) begin(file, rowOf(list, file));
  };
  // Of the whole page: a browser opens a file that is dropped elsewhere, in place of the page and its uploads.
  for (const name of ["dragover", "dragleave", "drop"]) {
    document.addEventListener(
      name,
      (event) => {
        event.preventDefault();
        form.classList.toggle("over", name === "dragover");
        if (name === "drop") take(event.dataTransfer.files);
      },
      true,
    );
  }
  addEventListener("beforeunload", (event) => coming && event.preventDefault());
  const field = form.querySelector("input[type=file]");
  field.addEventListener("change", () => {
    take(field.files);
    field.value = "";
  });
}

function rowOf(list, file) {
  const item = list.appendChild(document.createElement("li"));
  const name = item.appendChild(document.createElement("bdi"));
  const state = item.appendChild(document.createElement("span"));
  const bar = item.appendChild(document.createElement("progress"));
  name.textContent = file.name;
  state.textContent = "waiting";
  bar.max = Math.max(1, file.size);
  bar.value = 0;
  bar.setAttribute("aria-label", `How much of ${file.name} has been sent`);
  const mega = (bytes) => (bytes / 1e6).toFixed(1);
  return {
    show(what, bytes) {
      state.textContent = `${what} ${mega(bytes)} of ${mega(file.size)} MB`;
      bar.value = bytes;
    },
    done(what, link) {
      bar.value = bar.max;
      state.textContent = what;
      if (!link) return;
      const anchor = document.createElement("a");
      anchor.href = link;
      anchor.textContent = what;
      state.replaceChildren(anchor);
    },
    fail(error, again) {
      bar.hidden = true;
      state.className = "failed";
      state.textContent = error.message;
      if (!error.again) return;
      const button = document.createElement("button");
      button.className = "quiet";
      button.textContent = "Try again";
      button.addEventListener("click", () => {
        bar.hidden = false;
        state.className = "";
        state.textContent = "waiting";
        again();
      });
      state.append(" ", button);
    },
  };
}

async function send(form, file, row) {
  if (file.size > Number(form.dataset.most)) throw new Error("the file is larger than this server accepts");
  if (!file.size) throw new Error("the file is empty");
  let digest = null;
  for (let tries = 0; ; ) {
    try {
      digest ??= await digestOf(file, (read) => row.show("checking", read));
      const told = { "Upload-Length": String(file.size), "Upload-Metadata": `sha256 ${btoa(digest)}`, "Tus-Resumable": "1.0.0" };
      const begun = await ask(form, "POST", "/v1/uploads", told); // says how much has arrived, also after a lost answer
      let recording = begun.headers.get("Recording");
      if (recording !== null) return row.done("the server has it already", linkTo(recording));
      const place = begun.headers.get("Location");
      let offset = Number(begun.headers.get("Upload-Offset"));
      while (recording === null) {
        row.show("sent", offset);
        const headers = { "Upload-Offset": String(offset), "Recording-Name": encodeURIComponent(file.name), "Content-Type": "application/offset+octet-stream", "Tus-Resumable": "1.0.0" };
        const answer = await ask(form, "PATCH", place, headers, file.slice(offset, offset + PIECE));
        offset = Number(answer.headers.get("Upload-Offset"));
        recording = answer.headers.get("Recording");
        tries = 0;
      }
      return row.done("is here", linkTo(recording));
    } catch (error) {
      if (!error.again || ++tries > TRIES) throw error;
      await new Promise((later) => setTimeout(later, 1000 * tries));
    }
  }
}

function linkTo(recording) {
  const name = JSON.stringify(decodeURIComponent(recording));
  return `/episodes?${new URLSearchParams({ filter: `recording == ${name}` })}`;
}

function digestOf(file, tell) {
  return new Promise((resolve, reject) => {
    const worker = new Worker("/static/sha256.js", { type: "module" });
    worker.onerror = () => reject(unreachable()); // its script could not be loaded
    worker.onmessage = ({ data }) => {
      if (data.read !== undefined) return tell(data.read);
      worker.terminate();
      if (data.failed) reject(new Error("the file cannot be read: it is a directory, or was moved or changed; choose it again"));
      else resolve(data.hex);
    };
    worker.postMessage(file);
  });
}

// A request to the HTTP API with an access token of this page; fetches a new token when the old one has expired.
let token = null;
async function ask(form, method, address, headers, body) {
  for (let again = false; ; again = true) {
    token ??= await access(form);
    const answer = await reach(address, { method, body, headers: { ...headers, Authorization: `Bearer ${token}` } });
    if (answer.ok) return answer;
    if (answer.status === 401 && !again) {
      token = null;
      continue;
    }
    const told = await answer.json().catch(() => ({}));
    const later = [...LATER, GONE].includes(answer.status) || answer.headers.has("Upload-Offset");
    throw Object.assign(new Error(told.detail ?? `refused (${answer.status})`), { again: later });
  }
}

async function access(form) {
  const answer = await reach("/account/access", { method: "POST", body: new URLSearchParams({ code: form.dataset.code }) });
  if (!answer.ok) throw new Error("you are not signed in any more; reload this page");
  return (await answer.json()).access_token;
}

function reach(address, asked) {
  return fetch(address, asked).catch(() => {
    throw unreachable();
  });
}

function unreachable() {
  return Object.assign(new Error("the server cannot be reached"), { again: true });
}
