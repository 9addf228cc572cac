// The driving world from above: the ego always points up.

const COLOUR = {
  grass: "#d6e2d0", road: "#8b9097", route: "#a7b4c4", line: "#f4f4f4", middle: "#e6c85a",
  ego: "#16202a", car: "#e69f00", parked: "#c4b08c", wreck: "#7a3b2e", cone: "#cc3311",
  safe: "#009e73", danger: "#d55e00", mine: "#0072b2", goal: "#16202a",
};
const METRES = 78; // from the top of the picture to its bottom
const EGO = [2.4, 1.0]; // half length and half width, m

export class Road {
  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
    this.scene = null;
    this.frame = null;
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  draw() {
    const { canvas, pen, scene, frame } = this;
    const zoom = devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * zoom), height = Math.round(canvas.clientHeight * zoom);
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.fillStyle = COLOUR.grass;
    pen.fillRect(0, 0, width, height);
    if (!scene || !frame) return;
    const scale = height / METRES, [x, y, heading] = frame.ego;
    pen.translate(width / 2, height * 0.7);
    pen.scale(scale, -scale);
    pen.rotate(Math.PI / 2 - heading);
    pen.translate(-x, -y);
    this.#ground(scene);
    frame.boxes.forEach((pose, i) => this.#box(pose, scene.boxes[i], scene.wrecks[i] ? COLOUR.wreck : COLOUR.cone));
    for (const [cx, cy, radius] of scene.cones) this.#disc(cx, cy, Math.max(radius, 0.35), COLOUR.cone);
    frame.cars.forEach((pose, i) => {
      if (pose) this.#box(pose, scene.cars[i], pose[3] ? COLOUR.parked : COLOUR.car);
    });
    this.#box(frame.ego, EGO, COLOUR.ego);
    this.#nose(frame.ego);
    if (frame.mine) this.#path([[x, y], ...frame.mine], COLOUR.mine, "mine");
    if (frame.novice) this.#path(frame.novice, frame.fails ? COLOUR.danger : COLOUR.safe, frame.fails ? "fails" : "safe");
  }

  #ground(scene) {
    const { pen } = this;
    scene.roads.forEach((points, i) => {
      pen.fillStyle = scene.route[i] >= 0 ? COLOUR.route : COLOUR.road;
      pen.beginPath();
      points.forEach(([px, py]) => pen.lineTo(px, py));
      pen.fill();
    });
    for (const kind of [0, 1]) {
      pen.strokeStyle = kind ? COLOUR.middle : COLOUR.line;
      pen.lineWidth = 0.18;
      pen.beginPath();
      scene.lines.forEach(([ax, ay, bx, by], i) => {
        if (scene.middle[i] === kind) { pen.moveTo(ax, ay); pen.lineTo(bx, by); }
      });
      pen.stroke();
    }
    const [[ax, ay], [bx, by]] = scene.goal; // the finishing line, chequered
    pen.lineWidth = 1.2;
    pen.strokeStyle = "#fff";
    pen.beginPath(); pen.moveTo(ax, ay); pen.lineTo(bx, by); pen.stroke();
    pen.strokeStyle = COLOUR.goal;
    pen.setLineDash([0.6, 0.6]);
    pen.beginPath(); pen.moveTo(ax, ay); pen.lineTo(bx, by); pen.stroke();
    pen.setLineDash([]);
  }

  #box([x, y, heading], [long, wide], colour) {
    const { pen } = this;
    if (Math.abs(x) > 1e5) return;
    pen.save();
    pen.translate(x, y);
    pen.rotate(heading);
    pen.fillStyle = colour;
    pen.fillRect(-long, -wide, 2 * long, 2 * wide);
    pen.strokeStyle = "#fffc";
    pen.lineWidth = 0.12;
    pen.strokeRect(-long, -wide, 2 * long, 2 * wide);
    pen.restore();
  }

  #nose([x, y, heading]) {
    const { pen } = this;
    pen.save();
    pen.translate(x, y);
    pen.rotate(heading);
    pen.fillStyle = "#fff";
    pen.beginPath(); pen.moveTo(2.0, 0); pen.lineTo(0.9, 0.6); pen.lineTo(0.9, -0.6); pen.fill();
    pen.restore();
  }

  #disc(x, y, radius, colour) {
    const { pen } = this;
    pen.fillStyle = colour;
    pen.beginPath(); pen.arc(x, y, radius, 0, 7); pen.fill();
  }

  // told apart by shape too: dots and a solid line, a dashed line and a cross, hollow squares
  #path(points, colour, kind) {
    const { pen } = this;
    pen.strokeStyle = pen.fillStyle = colour;
    pen.lineWidth = 0.5;
    pen.setLineDash(kind === "fails" ? [1.2, 0.8] : []);
    pen.beginPath();
    points.forEach(([px, py]) => pen.lineTo(px, py));
    pen.stroke();
    pen.setLineDash([]);
    if (kind === "safe") points.forEach(([px, py]) => this.#disc(px, py, 0.45, colour));
    const [x, y] = points[points.length - 1];
    if (kind === "fails") {
      pen.lineWidth = 0.7;
      pen.beginPath();
      pen.moveTo(x - 1.4, y - 1.4); pen.lineTo(x + 1.4, y + 1.4);
      pen.moveTo(x - 1.4, y + 1.4); pen.lineTo(x + 1.4, y - 1.4);
      pen.stroke();
    }
    if (kind === "mine") {
      pen.lineWidth = 0.25;
      points.slice(1).forEach(([px, py]) => pen.strokeRect(px - 0.4, py - 0.4, 0.8, 0.8));
    }
  }
}
