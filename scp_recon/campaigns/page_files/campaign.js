"use strict";
/* Draws the charts of a campaign's page and opens cases; everything drawn comes from Plotly. */
window.campaign = (() => {
  const charts = JSON.parse(document.getElementById("report-data").textContent);
  const root = document.documentElement;
  const system = window.matchMedia("(prefers-color-scheme: dark)");
  const isDark = () => (root.dataset.theme ? root.dataset.theme === "dark" : system.matches);

  function themed(layout) {
    const [ink, rule] = isDark() ? ["#e8eaee", "#3a414c"] : ["#1c1f24", "#d5d9df"];
    const styled = {
      ...layout, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: ink, size: 12, family: "system-ui, sans-serif" }, hovermode: "closest",
    };
    for (const key of ["xaxis", "yaxis"]) {
      if (styled[key]) styled[key] = { gridcolor: rule, zerolinecolor: rule, linecolor: rule, showline: true, automargin: true, ...styled[key] };
    }
    return styled;
  }

  function show(number) {
    const row = document.getElementById(`case-${number}`);
    if (!row) return;
    open(row.querySelector("button"), true);
    row.scrollIntoView({ block: "center" });
  }

  function open(button, wanted) {
    button.setAttribute("aria-expanded", String(wanted));
    document.getElementById(button.getAttribute("aria-controls")).hidden = !wanted;
  }

  function draw() {
    return Promise.all([...document.querySelectorAll("[data-chart]")].map((place) => {
      const { data, layout } = charts[Number(place.dataset.chart)];
      const config = { displaylogo: false, responsive: true, scrollZoom: false,
        toImageButtonOptions: { format: "png", scale: 2, filename: place.parentElement.id } };
      return Plotly.react(place, data, themed(layout), config).then(() => {
        place.removeAllListeners("plotly_click");
        place.on("plotly_click", (event) => show(event.points[0].customdata));
      });
    }));
  }

  document.querySelectorAll("button.open").forEach((button) => button.addEventListener("click", () =>
    open(button, button.getAttribute("aria-expanded") !== "true")));
  document.getElementById("theme").addEventListener("click", () => {
    root.dataset.theme = isDark() ? "light" : "dark";
    draw();
  });
  return { drawn: draw(), show };
})();
