"use strict";
// The engine is unpacked only when the first figure is to be zoomed, so that the page opens at once.
(() => {
  if (window.DecompressionStream === undefined) {
    return;
  }
  const read = (id) => {
    const packed = Uint8Array.from(atob(document.getElementById(id).textContent), (letter) => letter.charCodeAt(0));
    return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };
  let engine;
  const start = async () => {
    const script = document.createElement("script");
    script.textContent = await read("engine");
    document.head.append(script);
    window.Bokeh.set_log_level("error");
  };
  const draw = async (key) => {
    engine ??= start();
    await engine;
    const told = JSON.parse(await read(`${key}-data`));
    const place = { docid: key, roots: { [told.root]: `${key}-live` }, root_ids: [told.root] };
    await window.Bokeh.embed.embed_items({ [key]: told.document }, [place]);
  };
  for (const button of document.querySelectorAll("button.zoom")) {
    const key = button.dataset.chart;
    const figure = document.getElementById(key);
    const live = document.getElementById(`${key}-live`);
    const still = figure.querySelector(".frame");
    let drawn;
    button.hidden = false;
    button.addEventListener("click", async () => {
      const shows = live.hidden;
      live.hidden = !shows;
      still.hidden = shows;
      button.setAttribute("aria-pressed", String(shows));
      button.textContent = shows ? "Back to the picture" : "Zoom and read values";
      if (shows && drawn === undefined) {
        drawn = draw(key);
        await drawn;
        figure.dataset.drawn = "true";
      }
    });
  }
})();
