"use strict";
(() => {
  const viewer = document.querySelector("model-viewer");
  const message = document.querySelector("main .message");
  const articles = [...document.querySelectorAll("article")];
  const links = [...document.querySelectorAll("nav a")];
  let shown = -1;
  let address = null;

  const tell = (text) => {
    message.textContent = text;
    message.hidden = !text;
  };

  // The file of a scene is decoded when the scene is shown, and forgotten when another one is.
  const decode = (number) => {
    const text = atob(document.querySelector(`script[data-model="${number}"]`).textContent);
    const bytes = new Uint8Array(text.length);
    for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
    return new Blob([bytes], { type: "model/gltf-binary" });
  };

  const orbit = (theta = null, phi = null, far = 1) => {
    const [x, y, z, distance, azimuth, polar] = articles[shown].dataset.view.split(" ").map(Number);
    // A narrow picture shows less from left to right, so the camera stands farther away.
    const narrow = Math.max(1, Math.min(2.5, 1.15 * viewer.clientHeight / Math.max(1, viewer.clientWidth)));
    viewer.cameraTarget = `${x}m ${y}m ${z}m`;
    viewer.cameraOrbit = `${theta ?? azimuth}deg ${phi ?? polar}deg ${far * narrow * distance}m`;
  };

  const rows = () => [...articles[shown].querySelectorAll("ul.objects li")];
  const labels = () => [...viewer.querySelectorAll(".label")];

  const addLabels = () => {
    for (const label of labels()) label.remove();
    for (const [k, row] of rows().entries()) {
      const label = document.createElement("span");
      label.className = row.closest("details") ? "label quiet" : "label";
      label.slot = `hotspot-${k}`;
      label.dataset.position = row.dataset.at.split(" ").map((value) => `${value}m`).join(" ");
      label.textContent = row.querySelector("b").textContent;
      viewer.append(label);
    }
  };

  const pick = (row) => {
    const all = rows();
    const number = row.classList.contains("picked") ? -1 : all.indexOf(row);
    all.forEach((other, k) => other.classList.toggle("picked", k === number));
    labels().forEach((label, k) => label.classList.toggle("picked", k === number));
    if (number < 0) return orbit();
    viewer.cameraTarget = row.dataset.centre.split(" ").map((value) => `${value}m`).join(" ");
  };

  const show = (number) => {
    if (number === shown) return;
    shown = number;
    articles.forEach((article, k) => (article.hidden = k !== number));
    links.forEach((link, k) => link.classList.toggle("shown", k === number));
    links[number].scrollIntoView({ block: "nearest" });
    for (const row of rows()) row.classList.remove("picked");
    document.querySelector("aside").scrollTop = 0;
    delete document.body.dataset.loaded;
    tell("Loading …");
    if (address) URL.revokeObjectURL(address);
    address = URL.createObjectURL(decode(number));
    orbit();
    viewer.src = address;
    addLabels();
  };

  const follow = () => {
    const wanted = new URLSearchParams(location.hash.slice(1));
    document.body.classList.toggle("only", wanted.has("only"));
    const number = Number(wanted.get("scene") ?? 0);
    show(Number.isInteger(number) && number >= 0 && number < articles.length ? number : 0);
  };

  viewer.addEventListener("load", () => {
    tell("");
    viewer.jumpCameraToGoal();
    document.body.dataset.loaded = String(shown);
  });
  viewer.addEventListener("error", () => {
    tell("The scene cannot be drawn. Does this browser have WebGL?");
    document.body.dataset.failed = "true";
  });
  document.querySelector("aside").addEventListener("click", (event) => {
    const row = event.target.closest("ul.objects li");
    if (row) pick(row);
  });
  document.querySelector(".tools").addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    const toggles = button.hasAttribute("aria-pressed");
    const on = toggles && button.getAttribute("aria-pressed") === "false";
    if (toggles) button.setAttribute("aria-pressed", String(on));
    if (button.dataset.do === "front") orbit(0, 70);
    if (button.dataset.do === "top") orbit(0, 0, 1.05);
    if (button.dataset.do === "turn") viewer.autoRotate = on;
    if (button.dataset.do === "labels") viewer.classList.toggle("labels", on);
  });
  addEventListener("keydown", (event) => {
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (!step || !document.activeElement?.closest("nav")) return;
    event.preventDefault();
    const next = links[Math.max(0, Math.min(links.length - 1, shown + step))];
    location.hash = next.hash;
    next.focus();
  });
  addEventListener("hashchange", follow);
  follow();
})();
