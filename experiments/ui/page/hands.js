// The person's controls: keyboard and gamepad, both at once.

const RAMP = { press: 4, release: 7 }; // per second: a key moves a lever instead of being one
const DEAD = 0.12; // of a stick
const SLOW = 0.4; // of the arm's full speed, 0.3 m/s: too fast for keys near a peg

const DRIVING = [
  ["ArrowLeft", "KeyA", 0, 1], ["ArrowRight", "KeyD", 0, -1],
  ["ArrowUp", "KeyW", 1, 1], ["ArrowDown", "KeyS", 1, -1],
];
const ARM = [
  ["ArrowUp", "KeyW", 0, 1], ["ArrowDown", "KeyS", 0, -1],
  ["ArrowLeft", "KeyA", 1, 1], ["ArrowRight", "KeyD", 1, -1],
  ["PageUp", "KeyR", 2, 1], ["PageDown", "KeyF", 2, -1],
  ["KeyJ", null, 3, 1], ["KeyL", null, 3, -1],
  ["KeyI", null, 4, 1], ["KeyK", null, 4, -1],
  ["KeyU", null, 5, 1], ["KeyO", null, 5, -1],
];
const GRIPPER = 6;

// function -> gamepad button or axis of the Xbox layout
const DRIVING_PAD = {
  "take over": { button: 5 }, "throttle": { button: 7 }, "brake": { button: 6 },
  "steer": { axis: 0, sign: -1 }, "pause, continue": { button: 9 },
};
const ARM_PAD = {
  "take over": { button: 5 }, "away": { axis: 1, sign: -1 }, "left": { axis: 0, sign: -1 },
  "up": { axis: 3, sign: -1 }, "turn": { axis: 2, sign: -1 },
  "tilt +": { button: 12 }, "tilt -": { button: 13 }, "roll +": { button: 14 }, "roll -": { button: 15 },
  "gripper": { button: 2 }, "pause, continue": { button: 9 },
};
const FAST = ["ShiftLeft", "ShiftRight"];
const NAMES = {
  ShiftLeft: "Shift",
  Space: "Space", ArrowLeft: "\u2190", ArrowRight: "\u2192", ArrowUp: "\u2191", ArrowDown: "\u2193",
  PageUp: "PgUp", PageDown: "PgDn",
};
const short = (code) => NAMES[code] ?? code.replace("Key", "");

export class Hands {
  constructor(about, changed, order) {
    this.size = about.actions;
    this.azimuth = (about.azimuth ?? 0) * Math.PI / 180;
    this.changed = changed;
    this.order = order;
    this.arm = about.drawing === "arm";
    this.bindings = (this.arm ? ARM : DRIVING).filter(([, , axis]) => axis < this.size);
    this.storage = "ppl-pad-" + (this.arm ? "arm" : "driving");
    this.pad = { ...(this.arm ? ARM_PAD : DRIVING_PAD) };
    for (const [name, bound] of Object.entries(this.#stored())) if (name in this.pad) this.pad[name] = bound;
    this.down = new Set();
    this.value = new Array(this.size).fill(0);
    this.gripper = -1;
    this.toggled = false;
    this.toggles = false;
    this.then = performance.now();
    this.listening = null; // the function whose button is being chosen
    this.before = {};
    addEventListener("keydown", (event) => this.#key(event, true));
    addEventListener("keyup", (event) => this.#key(event, false));
    addEventListener("blur", () => { this.down.clear(); this.changed(); });
  }

  #stored() {
    try { return JSON.parse(localStorage.getItem(this.storage)) ?? {}; } catch { return {}; }
  }

  #key(event, down) {
    if (event.target.matches?.("input[type=text], textarea") || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.matches?.("button, summary") && (event.code === "Space" || event.code === "Enter")) return;
    const code = event.code;
    const known = code === "Space" || (this.arm && FAST.includes(code)) || (this.arm && code === "KeyG") ||
      this.bindings.some(([one, other]) => code === one || code === other);
    if (!known) return;
    event.preventDefault();
    if (event.repeat) return;
    if (down) this.down.add(code); else this.down.delete(code);
    if (down && code === "Space" && this.toggles) this.toggled = !this.toggled;
    if (down && code === "KeyG") this.gripper = -this.gripper;
    this.changed();
  }

  #keys(seconds) {
    const full = this.arm && !FAST.some((code) => this.down.has(code)) ? SLOW : 1;
    const wanted = new Array(this.size).fill(0);
    for (const [one, other, axis, sign] of this.bindings) {
      if (this.down.has(one) || (other && this.down.has(other))) wanted[axis] += sign * full;
    }
    this.value = this.value.map((now, axis) => {
      const most = seconds * (wanted[axis] ? RAMP.press : RAMP.release);
      const turned = now * wanted[axis] < 0 ? 0 : now; // the other way: at once from the middle
      return turned + Math.max(-most, Math.min(most, wanted[axis] - turned));
    });
    return this.value;
  }

  gamepad() {
    return [...(navigator.getGamepads?.() ?? [])].find((pad) => pad && pad.connected) ?? null;
  }

  #read(pad, name) {
    const bound = this.pad[name];
    if (!pad || !bound) return 0;
    if ("button" in bound) return pad.buttons[bound.button]?.value ?? 0;
    const raw = (pad.axes[bound.axis] ?? 0) * bound.sign;
    const size = Math.abs(raw);
    return size < DEAD ? 0 : Math.sign(raw) * (size - DEAD) / (1 - DEAD);
  }

  #pressed(pad, name) { // since the last look
    const now = this.#read(pad, name) > 0.5;
    const news = now && !this.before[name];
    this.before[name] = now;
    return news;
  }

  #choose(pad) { // "press any button"
    const button = pad.buttons.findIndex((one) => one.pressed);
    const axis = pad.axes.findIndex((value) => Math.abs(value) > 0.7);
    if (button < 0 && axis < 0) return;
    this.pad[this.listening] = button >= 0 ? { button } : { axis, sign: Math.sign(pad.axes[axis]) };
    localStorage.setItem(this.storage, JSON.stringify(this.pad));
    this.before[this.listening] = true;
    this.listening = null;
  }

  now() {
    const time = performance.now();
    const action = [...this.#keys(Math.min(0.2, (time - this.then) / 1000))];
    this.then = time;
    const pad = this.gamepad();
    if (pad && this.listening) this.#choose(pad);
    else if (pad) this.#add(pad, action);
    if (this.arm) this.#turn(action);
    if (this.size > GRIPPER) action[GRIPPER] = this.gripper;
    const held = this.toggles ? this.toggled : this.down.has("Space") || this.#read(pad, "take over") > 0.5;
    return { takeover: held, action: action.map((part) => Math.max(-1, Math.min(1, part))) };
  }

  #turn(action) { // "away" in the picture is some direction in the plane of the table
    const [away, left] = action, c = Math.cos(this.azimuth), s = Math.sin(this.azimuth);
    action[0] = c * away - s * left;
    action[1] = s * away + c * left;
  }

  #add(pad, action) {
    const read = (name) => this.#read(pad, name);
    if (this.arm) {
      const moved = [read("away"), read("left"), read("up"), read("roll +") - read("roll -"),
        read("tilt +") - read("tilt -"), read("turn")];
      moved.slice(0, this.size).forEach((part, axis) => { action[axis] += part; });
      if (this.#pressed(pad, "gripper")) this.gripper = -this.gripper;
    } else {
      action[0] += read("steer");
      action[1] += read("throttle") - read("brake");
    }
    if (this.#pressed(pad, "take over") && this.toggles) this.toggled = !this.toggled;
    if (this.#pressed(pad, "pause, continue")) this.order("pause");
  }

  standing() { // while the clock stands, the pause button starts it
    const pad = this.gamepad();
    if (pad && this.listening) this.#choose(pad);
    else if (pad && this.#pressed(pad, "pause, continue")) this.order("start");
  }

  release() { this.toggled = false; this.down.clear(); }

  help() { // rows of [what, keys]
    const words = this.arm
      ? ["away", "towards you", "left", "right", "up", "down", "roll +", "roll -", "tilt +", "tilt -", "turn +", "turn -"]
      : ["steer left", "steer right", "throttle", "brake"];
    const rows = [["take over", ["Space"]]];
    this.bindings.forEach(([one, other], i) => rows.push([words[i], [one, other].filter(Boolean)]));
    if (this.arm) rows.push(["fast", ["ShiftLeft"]]);
    if (this.size > GRIPPER) rows.push(["open or close gripper", ["KeyG"]]);
    return rows.map(([what, codes]) => [what, codes.map(short)]);
  }
}
