"use strict";
// The engine is read only when the first figure is to be zoomed, so that the page opens at once.
(() => {
  const start = () => {
    if (window.Bokeh === undefined) {
      const script = document.createElement("script");
      script.textContent = document.getElementById("engine").textContent;
      document.head.append(script);
      window.Bokeh.set_log_level("error");
    }
  };
  const draw = async (key) => {
    const told = JSON.parse(document.getElementById(`${key}-data`).textContent);
    const place = { docid: key, roots: { [told.root]: `${key}-live` }, root_ids: [told.root] };
    await window.Bokeh.embed.embed_items({ [key]: told.document }, [place]);
  };
  for (const button of document.querySelectorAll("button.zoom")) {
    const key = button.dataset.chart;
    const figure = document.getElementById(key);
    const live = document.getElementById(`${key}-live`);
    const still = figure.querySelector(".frame");
    button.hidden = false;
    button.addEventListener("click", async () => {
      const shows = live.hidden;
      live.hidden = !shows;
      still.hidden = shows;
      button.setAttribute("aria-pressed", String(shows));
      button.textContent = shows ? "Back to the picture" : "Zoom and read values";
      if (shows && !live.hasChildNodes()) {
        start();
        await draw(key);
        figure.dataset.drawn = "true";
      }
    });
  }
})();
