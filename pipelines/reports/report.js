"use strict";
// A click on a picture puts the scene that can be turned in its place.
document.addEventListener("click", (event) => {
  const link = event.target.closest("a.turn");
  if (!link || event.ctrlKey || event.metaKey || event.shiftKey || event.button) return;
  event.preventDefault();
  const frame = document.createElement("iframe");
  frame.src = `${link.getAttribute("href")}&only`;
  frame.title = "The scene, which can be turned";
  frame.style.aspectRatio = link.offsetWidth / Math.max(1, link.offsetHeight);
  link.replaceWith(frame);
});
