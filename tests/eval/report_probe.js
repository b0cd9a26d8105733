// Appended to a copy of the report by test_report_browser.py: works the page and writes what happened into the DOM.
(async () => {
  const result = { errors: window.probeErrors, ready: document.documentElement.dataset.ready };
  const checksum = () => {
    viewer.draw();
    const gl = viewer.gl, w = gl.drawingBufferWidth, h = gl.drawingBufferHeight, px = new Uint8Array(4 * w * h);
    gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, px);
    let drawn = 0, sum = 0;
    for (let i = 0; i < px.length; i += 4) {
      if (Math.abs(px[i] - px[0]) + Math.abs(px[i + 1] - px[1]) + Math.abs(px[i + 2] - px[2]) > 12) drawn++;
      sum = (Math.imul(sum, 31) + px[i] + 7 * px[i + 1] + 13 * px[i + 2]) | 0;
    }
    return { drawn, sum };
  };
  if (!viewer.gl) { result.nogl = true; }
  else {
    result.start = checksum(); result.toggles = {};
    viewer.draw(0.1); const draw = viewer.draw; viewer.draw = () => {}; result.sparse = checksum().drawn; viewer.draw = draw;
    for (const input of document.querySelectorAll("#toggles input")) {
      const before = checksum(); input.click(); const after = checksum(); input.click();
      result.toggles[input.id] = { changed: before.sum !== after.sum, restored: checksum().sum === before.sum };
    }
    result.colours = {};
    for (const option of document.getElementById("colour").options) {
      document.getElementById("colour").value = option.value;
      document.getElementById("colour").dispatchEvent(new Event("change"));
      result.colours[option.value] = checksum().sum;
    }
    result.views = {};
    for (const button of document.querySelectorAll(".views button")) { button.click(); result.views[button.dataset.view] = checksum(); }
    const canvas = document.getElementById("scene");
    document.querySelector("[data-view=free]").click();
    const gesture = (type, init) => canvas.dispatchEvent(new PointerEvent(type, { bubbles: true, pointerId: 1, buttons: 1, ...init }));
    canvas.setPointerCapture = () => {};
    const still = checksum().sum;
    gesture("pointerdown", { clientX: 200, clientY: 200 }); gesture("pointermove", { clientX: 260, clientY: 220 }); gesture("pointerup", {});
    result.moving = viewer.moving; result.turned = checksum().sum !== still;
    const turned = checksum().sum;
    canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: -100, cancelable: true }));
    result.zoomed = checksum().sum !== turned;
    gesture("pointerdown", { pointerId: 1, clientX: 100, clientY: 200 }); gesture("pointerdown", { pointerId: 2, clientX: 200, clientY: 200 });
    const distance = viewer.distance;
    gesture("pointermove", { pointerId: 2, clientX: 220, clientY: 200 }); gesture("pointermove", { pointerId: 2, clientX: 300, clientY: 200 });
    result.pinched = viewer.distance < distance;
    gesture("pointerup", { pointerId: 1 }); gesture("pointerup", { pointerId: 2 });
    const sigma = document.getElementById("sigma"), before = checksum();
    sigma.value = 10; sigma.dispatchEvent(new Event("input")); result.sigmaHides = checksum().drawn < before.drawn;
  }
  const flat = document.getElementById("top"), px = flat.getContext("2d").getImageData(0, 0, flat.width, flat.height).data;
  result.flatColours = new Set(Array.from({ length: px.length / 4 }, (_, i) => (px[4 * i] << 16) | (px[4 * i + 1] << 8) | px[4 * i + 2])).size;
  result.charts = [...document.querySelectorAll(".chart svg path")].filter(p => p.getAttribute("d").length > 10).length;
  result.sections = [...document.querySelectorAll("section[id^=s-]:not([hidden])")].map(s => s.id);
  result.wide = document.documentElement.scrollWidth > document.documentElement.clientWidth + 1;
  result.requests = performance.getEntriesByType("resource").map(r => r.name).filter(n => !n.startsWith("data:"));
  const pre = document.createElement("pre"); pre.id = "probe"; pre.textContent = JSON.stringify(result); document.body.append(pre);
})();
