// Starts the Rerun viewer (its script defines `wasm_bindgen`) with the data that the page names.

// The viewer asks without the cookie, and a server then answers with its sign-in page.
const fetched = window.fetch;
window.fetch = (asked, options) => fetched(asked, { ...options, credentials: "same-origin" });

(async () => {
  const canvas = document.getElementById("viewer");
  const status = document.querySelector(".coming");
  try {
    await wasm_bindgen({ module_or_path: `${canvas.dataset.files}/re_viewer_bg.wasm` });
    const handle = new wasm_bindgen.WebHandle({
      url: [new URL(canvas.dataset.replay, location.href).href],
      hide_welcome_screen: true,
      enable_history: false,
      notebook: false,
      persist: false,
      theme: "system",
      panel_state_overrides: { top: "Hidden", blueprint: "Collapsed", selection: "Hidden", time: "Collapsed" },
    });
    await handle.start(canvas);
    status.remove();
  } catch (error) {
    status.textContent = `The viewer cannot run in this browser: ${error}`;
    canvas.remove();
  }
})();
