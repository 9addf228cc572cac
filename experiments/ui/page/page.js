// The page of a session: the socket, the stages, the figures. Drawing is in road.js, hands in hands.js.
import { Hands } from "/hands.js";
import { Road } from "/road.js";

const $ = (id) => document.getElementById(id);
const road = new Road($("road"));
const losses = [];
let about = null, status = { stage: "connecting", note: "" }, role = { control: false, free: false, watching: 0 };
let frame = null, hands = null, socket = null, over = false, bannerTimer = 0;

function send(message) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}
const order = (name) => send({ kind: "order", order: name });

function hand() {
  if (!hands || !role.control || about.replay) return;
  send({ kind: "input", seen: frame?.number ?? 0, ...hands.now() });
}

function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/talk`);
  socket.binaryType = "blob";
  socket.onmessage = ({ data }) => {
    if (typeof data !== "string") return picture(data);
    const message = JSON.parse(data);
    (RECEIVE[message.kind] ?? (() => {}))(message);
  };
  socket.onclose = () => {
    if (over) return;
    status = { stage: "connecting", note: "connection lost; trying again" };
    render();
    setTimeout(connect, 1000);
  };
}

async function picture(blob) {
  const image = $("picture");
  const old = image.src;
  image.src = URL.createObjectURL(blob.slice(4, blob.size, "image/jpeg"));
  image.hidden = false;
  if (old) URL.revokeObjectURL(old);
}

const RECEIVE = {
  about(message) {
    about = message;
    if (!hands) { hands = new Hands(about, hand, order); keys(); }
    $("title").textContent = `${about.env.replaceAll("_", " ")} \u00b7 ${about.algorithm}` + (about.participant ? ` \u00b7 ${about.participant}` : "");
    document.title = `ppl play ${about.env}`;
    $("road").hidden = about.drawing !== "road";
    $("seeking").hidden = !about.replay;
    $("controls").hidden = Boolean(about.replay);
    $("seek").max = about.total - 1;
    $("seek").oninput = () => send({ kind: "seek", step: Number($("seek").value) });
  },
  status(message) {
    status = message;
    over = status.stage === "stopped" || status.stage === "finished" || status.stage === "failed";
    if (status.stage !== "running") hands?.release();
    render();
  },
  role(message) { role = message; render(); },
  scene(message) { road.scene = message; },
  frame(message) {
    frame = message;
    hand();
    if (about.drawing === "road") { road.frame = message; road.draw(); }
    const loss = Object.entries(message.losses);
    if (loss.length && message.step % 10 === 0) losses.push(Object.fromEntries(loss));
    if (losses.length > 600) losses.shift();
    if (about.replay) $("seek").value = message.step;
    if (message.ended) banner(message.ended === "success" ? "\u2713 success" : "\u2717 episode over");
    figures();
  },
  rejected(message) { console.warn("rejected:", message.why); },
};

function banner(text) {
  $("banner").textContent = text;
  $("banner").hidden = false;
  clearTimeout(bannerTimer);
  bannerTimer = setTimeout(() => { $("banner").hidden = true; }, 1500);
}

const share = (part, whole) => whole ? `${Math.round(100 * part / whole)} %` : "\u2013";

function figures() {
  const f = frame;
  if (!f || !about) return;
  const practice = status.stage === "practice";
  const rows = [
    ...f.more,
    ["step", `${f.step} / ${about.total}`],
    ["takeovers", f.takeovers],
    ["steps by you", `${f.human} (${share(f.human, f.step)})`],
    ["episodes", f.episodes],
    ["success so far", `${f.successes} (${share(f.successes, f.episodes)})`],
    ["cost", f.cost],
  ];
  if (!about.replay) rows.push(["late ticks", `${f.missed} of ${f.ticks}`]);
  if (practice) rows.push(["in a row", `${status.in_a_row} / ${status.familiarisation || "\u2013"}`]);
  $("figures").replaceChildren(...rows.map(([name, value]) => {
    const cell = document.createElement("div");
    const term = document.createElement("dt"), text = document.createElement("dd");
    term.textContent = name; text.textContent = value;
    cell.append(term, text);
    return cell;
  }));
  const going = status.stage === "running" || practice || about.replay;
  const who = $("who"), forecast = $("forecast");
  who.textContent = !going ? status.stage : practice ? "practice: you drive, and nothing is learnt" :
    f.takeover ? (about.replay ? "the person is in control" : "YOU are in control") : "the novice is in control";
  who.className = going && f.takeover ? "mine" : "";
  const shown = going && !practice && f.novice !== null;
  forecast.textContent = !shown ? "" : f.fails ? "\u2717 predicted to fail" : "\u2713 predicted path is safe";
  forecast.className = f.fails ? "fails" : "safe";
  $("stage").className = !going ? "" : f.fails && !f.takeover ? "fails" : f.takeover ? "mine" : "novice";
  drawLoss();
}

function drawLoss() {
  const canvas = $("loss"), pen = canvas.getContext("2d");
  pen.clearRect(0, 0, canvas.width, canvas.height);
  const names = Object.keys(losses[losses.length - 1] ?? {}).filter((name) => name.startsWith("loss"));
  const name = names.find((one) => one === "loss_bc") ?? names[0];
  if (!name) { $("lossnote").textContent = "training loss: nothing learnt yet"; return; }
  const values = losses.map((row) => row[name]).filter(Number.isFinite);
  const low = Math.min(...values), high = Math.max(...values, low + 1e-6);
  pen.beginPath();
  pen.strokeStyle = "#16202a";
  values.forEach((value, i) => pen.lineTo(
    4 + (canvas.width - 8) * i / Math.max(1, values.length - 1),
    canvas.height - 6 - (canvas.height - 12) * (value - low) / (high - low)));
  pen.stroke();
  $("lossnote").textContent = `training loss (${name.replace("loss_", "")}): ${values[values.length - 1].toFixed(3)}`;
}

const BUTTONS = [ // name, label, key, stages in which it works
  ["start", "Start", "Enter", ["ready", "paused", "practice"]],
  ["pause", "Pause", "KeyP", ["running", "practice"]],
  ["restart", "Restart", "Backspace", ["running", "paused"]],
  ["practice", "Practise", "KeyX", ["ready", "paused", "running"]],
  ["save", "Save", "KeyV", ["ready", "running", "paused"]],
  ["quit", "Save, quit", "KeyQ", ["consent", "ready", "running", "paused", "practice", "questions", "finished"]],
];

const BINDING = { Enter: "\u21b5", KeyP: "P", Backspace: "\u232b", KeyX: "X", KeyV: "V", KeyQ: "Q" };

function render() {
  const waiting = status.stage === "practice" && status.in_a_row < status.familiarisation;
  const offered = BUTTONS.filter(([name]) => !about?.replay || !["practice", "save"].includes(name));
  $("buttons").replaceChildren(...offered.map(([name, text, key, stages]) => {
    const button = document.createElement("button");
    const badge = document.createElement("kbd");
    badge.textContent = BINDING[key];
    button.append(`${text} `, badge);
    button.id = `do-${name}`;
    button.disabled = !role.control || !stages.includes(status.stage) || (name === "start" && waiting);
    button.onclick = () => { order(name); button.blur(); };
    if (name === "start") button.className = "main";
    return button;
  }));
  if (role.free && !role.control) {
    const take = document.createElement("button");
    take.textContent = "Take the controls";
    take.onclick = () => order("control");
    $("buttons").append(take);
  }
  const others = role.watching ? `, ${role.watching} more page${role.watching > 1 ? "s" : ""} open` : "";
  $("role").textContent = (role.control ? "you have the controls" : "you are watching") + others;
  if (!frame) { $("who").textContent = status.stage; }
  panel();
  figures();
}

function text(tag, content) {
  const element = document.createElement(tag);
  element.textContent = content;
  return element;
}

function button(label, action, main = false) {
  const made = text("button", label);
  made.type = "button";
  made.onclick = action;
  if (main) made.className = "main";
  return made;
}

const HEADINGS = {
  connecting: "Connecting", preparing: "Getting ready", consent: "Before we start", ready: "Ready",
  paused: "Paused", questions: "A few questions", finished: "Done", stopped: "Saved", failed: "An error ended the session",
};

let drawn = "";
function panel() {
  const form = $("panel"), { stage } = status;
  const key = JSON.stringify([status, role.control]);
  if (key === drawn) return;
  drawn = key;
  form.hidden = !(stage in HEADINGS) || (about?.replay && (stage === "ready" || stage === "paused"));
  if (form.hidden) { $("road").focus(); return; }
  const parts = [text("h2", HEADINGS[stage])];
  if (status.note) parts.push(text("p", status.note));
  if (stage === "preparing") parts.push(text("p", "The clock is not running yet."));
  if (stage === "ready" || stage === "paused") parts.push(text("p", introduction()), button("Start (Enter)", () => order("start"), true));
  if (stage === "consent") {
    parts.push(text("pre", status.text),
      button("I agree", () => send({ kind: "consent", agreed: true }), true), " ",
      button("I do not agree", () => send({ kind: "consent", agreed: false })));
  }
  if (stage === "questions") parts.push(...questions(form));
  form.replaceChildren(...parts);
  if (!role.control) form.querySelectorAll("button, input").forEach((one) => { one.disabled = true; });
  (form.querySelector("button.main, input") ?? form).focus?.();
}

function introduction() {
  const names = about?.drawing === "road" ? "the car" : "the arm";
  const how = hands?.toggles ? "press" : "hold";
  return `The novice moves ${names}, and its predicted path is drawn ahead: green with dots if it is ` +
    `safe, red, dashed and with a cross if it is predicted to fail. To take over, ${how} Space and ` +
    "steer; your own path is blue. The novice learns from every takeover.";
}

function questions(form) {
  const parts = [];
  for (const question of status.questions) {
    parts.push(text("label", question.text));
    if (question.choices.length) {
      const field = document.createElement("fieldset");
      for (const choice of question.choices) {
        const label = document.createElement("label"), radio = document.createElement("input");
        radio.type = "radio"; radio.name = question.name; radio.value = choice;
        label.append(radio, ` ${choice}`);
        field.append(label);
      }
      parts.push(field);
    } else {
      const input = document.createElement("input");
      input.type = "text"; input.name = question.name; input.maxLength = 2000;
      parts.push(input);
    }
  }
  const done = () => send({ kind: "answers", answers: Object.fromEntries(new FormData(form)) });
  form.onsubmit = (event) => { event.preventDefault(); done(); };
  parts.push(button("Continue", done, true));
  return parts;
}

function keys() {
  const row = ([what, codes]) => {
    const line = document.createElement("tr"), cell = document.createElement("td");
    codes.forEach((code) => cell.append(text("kbd", code), " "));
    line.append(text("td", what), cell);
    return line;
  };
  $("keys").replaceChildren(...hands.help().map(row));
  for (const radio of document.querySelectorAll("input[name=hold]")) {
    radio.onchange = () => { hands.toggles = radio.value === "toggle" && radio.checked; hands.release(); render(); radio.blur(); };
  }
  setInterval(pads, 100);
}

const NO_PAD = $("pad").textContent;
let mapped = "";
function pads() {
  const pad = hands.gamepad();
  if (!pad) {
    if (mapped) { mapped = ""; $("pad").textContent = NO_PAD; $("mapping").replaceChildren(); }
    return;
  }
  if (!["running", "practice"].includes(status.stage)) hands.standing();
  const key = JSON.stringify([hands.pad, hands.listening, pad.id]);
  if (key === mapped) return;
  mapped = key;
  $("pad").textContent = pad.id;
  const rows = Object.entries(hands.pad).flatMap(([name, bound]) => {
    const where = "button" in bound ? `button ${bound.button}` : `axis ${bound.axis}`;
    const choose = button(hands.listening === name ? "press any button" : where, () => { hands.listening = name; pads(); });
    choose.setAttribute("aria-label", `${name}: ${where}; change`);
    return [text("span", name), choose];
  });
  $("mapping").replaceChildren(...rows);
}

addEventListener("keydown", (event) => {
  if (event.repeat || event.ctrlKey || event.metaKey || event.target.matches?.("input[type=text], textarea")) return;
  if (event.code === "Enter" && event.target.matches?.("button, summary, input")) return; // Enter presses the focused element
  const found = BUTTONS.find(([, , key]) => key === event.code) ?? (event.code === "Escape" ? BUTTONS[1] : null);
  if (!found || $(`do-${found[0]}`)?.disabled) return;
  event.preventDefault();
  order(found[0]);
});

render();
connect();
