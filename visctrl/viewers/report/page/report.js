// Under the pointer: the time in every chart, the values beside the names, the robot on its path.
"use strict";
(() => {
  const charts = [...document.querySelectorAll("figure.chart")].map((figure) => {
    const numbers = (name) => figure.dataset[name].split(",").map(Number);
    return {
      figure,
      x: numbers("x"),
      y: numbers("y"),
      svg: figure.querySelector("svg"),
      cursor: figure.querySelector(".cursor"),
      lines: [...figure.querySelectorAll(".line")].map(points),
      outputs: [...figure.querySelectorAll("output")],
      stacked: "stacked" in figure.dataset,
    };
  });
  const robots = [...document.querySelectorAll("g.robot")].map((group) => ({
    group,
    poses: group.dataset.poses.split(";").map((row) => row.split(",").map(Number)),
  }));

  // Gaps stay as points without a value.
  function points(path) {
    return path.getAttribute("d").split("M").slice(1).flatMap((run) => [
      ...run.replace("h0.1", "").split("L").map((pair) => pair.split(" ").map(Number)),
      [NaN, NaN],
    ]);
  }

  function valueAt(line, u) {
    let best = null;
    for (const point of line) {
      if (point[0] <= u + 1e-6) best = point;
      else if (point[0] > u) return best && !Number.isNaN(best[0]) ? best[1] : null;
    }
    return best && !Number.isNaN(best[0]) && u - best[0] < 3 ? best[1] : null;
  }

  function show(t) {
    for (const { x, y, cursor, lines, outputs, stacked } of charts) {
      const u = x[2] + ((t - x[0]) / (x[1] - x[0])) * (x[3] - x[2]);
      cursor.setAttribute("x1", u);
      cursor.setAttribute("x2", u);
      cursor.style.visibility = u < x[2] || u > x[3] ? "hidden" : "visible";
      let below = 0;
      lines.forEach((line, k) => {
        const v = valueAt(line, u);
        if (v === null) { outputs[k].textContent = ""; return; }
        let value = y[0] + ((v - y[2]) / (y[3] - y[2])) * (y[1] - y[0]);
        if (stacked) [value, below] = [value - below, value];
        const digits = Math.max(0, 2 - Math.floor(Math.log10((y[1] - y[0]) || 1)));
        outputs[k].textContent = value.toFixed(Math.min(digits, 8)).replace(/^-(?=0\.?0*$)/, "").replace("-", "−");
      });
    }
    for (const { group, poses } of robots) {
      let pose = poses[0];
      for (const next of poses) if (next[0] <= t) pose = next;
      if (!pose || pose.length < 4) continue;
      group.removeAttribute("hidden");
      group.setAttribute("transform", `translate(${pose[1]} ${pose[2]}) rotate(${pose[3]})`);
    }
  }

  function hide() {
    for (const { cursor, outputs } of charts) {
      cursor.style.visibility = "hidden";
      for (const output of outputs) output.textContent = "";
    }
    for (const { group } of robots) group.setAttribute("hidden", "");
  }

  for (const { svg, x } of charts) {
    const follow = (event) => {
      const box = svg.getBoundingClientRect();
      const u = ((event.clientX - box.left) / box.width) * svg.viewBox.baseVal.width;
      const share = Math.min(1, Math.max(0, (u - x[2]) / (x[3] - x[2])));
      show(x[0] + share * (x[1] - x[0]));
    };
    svg.addEventListener("pointermove", follow);
    svg.addEventListener("pointerdown", follow);
    svg.addEventListener("pointerleave", (event) => { if (event.pointerType === "mouse") hide(); });
  }
})();
