// Evaluated in the report by test_report_browser.py: works the page and returns what happened.
(async () => {
  const result = { ready: document.documentElement.dataset.ready };
  const pixels = () => {
    const gl = viewer.gl, w = gl.drawingBufferWidth, h = gl.drawingBufferHeight, px = new Uint8Array(4 * w * h);
    gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, px);
    let drawn = 0, sum = 0;
    for (let i = 0; i < px.length; i += 4) {
      if (Math.abs(px[i] - px[0]) + Math.abs(px[i + 1] - px[1]) + Math.abs(px[i + 2] - px[2]) > 12) drawn++;
      sum = (Math.imul(sum, 31) + px[i] + 7 * px[i + 1] + 13 * px[i + 2]) | 0;
    }
    return { drawn, sum };
  };
  const checksum = () => { viewer.draw(); return pixels(); };
  if (!viewer.gl) { result.nogl = true; }
  else {
    const pending = viewer.next; viewer.next = () => {};  // frames are called from here only
    result.start = checksum(); result.toggles = {};
    viewer.draw(0.1 * viewer.total()); result.sparse = pixels().drawn;
    // Points in the frames after a change, and the picture that comes of them.
    viewer.budget = Math.ceil(viewer.total() / 7); viewer.moving = false; viewer.dirty = true;
    const chunks = [], drawPoints = viewer.drawPoints;
    viewer.drawPoints = function (from, to) { chunks.push([from, Math.min(to, this.total())]); drawPoints.call(this, from, to); };
    const adapt = viewer.adapt; viewer.adapt = () => {};
    for (let k = 0; k < 20; k++) viewer.frame(k);
    result.chunks = chunks; result.refined = pixels().sum; viewer.drawPoints = drawPoints; viewer.adapt = adapt;
    // A machine of its own clock: 5 ms per frame and so many microseconds a point, turned for 60 frames.
    const turn = micros => {
      viewer.budget = FIRST_POINTS; viewer.last = 0; let now = 5000; const gaps = [];
      viewer.begin = () => {}; viewer.drawPoints = () => {};
      for (let k = 0; k < 60; k++) { const took = Math.max(1000 / 60, 5 + viewer.budget * micros / 1000); gaps.push(took); viewer.dirty = viewer.moving = true; viewer.frame(now += took); }
      delete viewer.begin; delete viewer.drawPoints; viewer.moving = false;
      return { gaps, points: viewer.budget };
    };
    result.paced = { slow: turn(6), fast: turn(0.01), total: viewer.total() };
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
    viewer.next = pending;
  }
  const flat = document.getElementById("top"), px = flat.getContext("2d").getImageData(0, 0, flat.width, flat.height).data;
  result.flatColours = new Set(Array.from({ length: px.length / 4 }, (_, i) => (px[4 * i] << 16) | (px[4 * i + 1] << 8) | px[4 * i + 2])).size;
  result.charts = [...document.querySelectorAll(".chart svg path")].filter(p => p.getAttribute("d").length > 10).length;
  result.sections = [...document.querySelectorAll("section[id^=s-]:not([hidden])")].map(s => s.id);
  result.wide = document.documentElement.scrollWidth > document.documentElement.clientWidth + 1;
  result.requests = performance.getEntriesByType("resource").map(r => r.name).filter(n => !n.startsWith("data:"));
  return result;
})()
