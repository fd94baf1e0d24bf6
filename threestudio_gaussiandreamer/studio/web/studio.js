"use strict";
// The page of the studio. What it shows is text, never markup.

const FIELDS = {
  prompt: "system.prompt_processor.prompt",
  negative: "system.prompt_processor.negative_prompt",
  steps: "trainer.max_steps",
  scale: "system.guidance.guidance_scale",
  seed: "seed",
  gain: "system.geometry.prune.gain",
  count: "system.geometry.budget",
};
const MESH = "system.guidance.mesh", PRIOR = "system.geometry.prior";
const MESHES = /\.(glb|gltf|obj|stl|off|3mf|dae)$/i, GAUSSIANS = /\.(spz|sog|splat|ksplat|usd[acz]?|spz\.glb)$/i;

const STOPPED = [130, -2];  // exit codes after Ctrl-C, before the launcher is loaded the signal
const BUDGETS = { psnr: "PSNR to this, dB", auto: "quality, dB", count: "count", bytes: "size of the file" };
const UNREACHED = "The studio isn't reached; trying again ...";
const PROGRESS = /\d+%\||\?it\/s|\?, \?/;

const $ = (id) => document.getElementById(id);
let about = { missing: [], limit: 0, configs: {} }, state = null, shelf = [], chosen = null, file = null, sending = "", socket = null;

/** Make an element with properties and children, which are elements or texts. */
function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children.filter((child) => child !== null));
  return element;
}

const address = (path) => "files/" + path.split("/").map((part) => encodeURIComponent(part.toWellFormed())).join("/");
// text of any direction, which doesn't turn what is behind it
const isolated = (text) => `\u2068${text}\u2069`;
const say = (text) => { $("message").textContent = text; };
const ask = (message) => {
  if (socket.readyState !== WebSocket.OPEN) return say(UNREACHED);
  say("");
  socket.send(JSON.stringify(message));
};

function size(bytes) {
  return bytes < 1e6 ? `${Math.ceil(bytes / 1e3)} kB` : `${(bytes / 1e6).toFixed(1)} MB`;
}

// ---- the socket ---------------------------------------------------------------------------------

function connect() {
  socket = new WebSocket(location.href.replace(/^http/, "ws").replace(/[?#].*/, "") + "studio");
  socket.onmessage = (event) => {
    const told = JSON.parse(event.data);
    if (told.error !== undefined) return say(told.error);
    if (told.path) { say(""); return setFile({ ...told, name: sending }); }
    if (told.configs) { about = told; mark(); showDefaults(); }
    else if (told.shelf) { shelf = told.shelf; showShelf(); }
    else { state = told; showState(); }
  };
  socket.onclose = () => { say(UNREACHED); setTimeout(connect, 1000); };
  socket.onopen = () => say("");
}

/** Mark what can't make anything without weights. */
function mark() {
  for (const option of $("choice").options)
    if (about.missing.includes(option.value.split(" ").pop()) && !option.text.endsWith(")")) option.text += " (weights not found)";
}

/** Show as placeholders what the chosen configurations give. */
function showDefaults() {
  const given = Object.assign({ [FIELDS.gain]: 0.5 }, ...$("choice").value.split(" ").map((name) => about.configs[name]));
  for (const key of ["steps", "scale", "seed", "gain", "count"]) $(key).placeholder = given[FIELDS[key]] ?? "none";
}

// ---- the form -----------------------------------------------------------------------------------

/** Return the launcher's arguments for a prompt. */
function words(prompt) {
  const configs = $("choice").value.split(" ").flatMap((name) => ["--config", name]);
  const given = Object.keys(FIELDS).map((key) => [key, key === "prompt" ? prompt : $(key).value.trim()]);
  const options = given.filter(([, value]) => value).map(([key, value]) => `${FIELDS[key]}=${value}`);
  if (file && $("choice").value === "demo.yaml") options.push(`${MESH}=${file.path}`);
  else if (file) options.push(...startOf(file));
  return [...configs, "--train", `exp_root_dir=${about.root}`, ...options, ...split($("more").value)];
}

/** Split a command line into its words, as a shell does. */
function split(text) {
  const words = text.match(/(?:'[^']*'|"[^"]*"|[^\s'"])+/g) || [];
  return words.map((word) => word.replace(/'([^']*)'|"([^"]*)"/g, "$1$2"));
}

function startOf({ path, gaussians }) {
  const kind = gaussians || GAUSSIANS.test(path) ? "gaussians" : MESHES.test(path) ? "mesh" : "point-cloud";
  const points = kind === "mesh" ? [`${PRIOR}.num_points=3000`] : [];
  return [`${PRIOR}_type=${kind}-prior`, `${PRIOR}.path=${path}`, ...points];
}

function start() {
  const idle = !state.job;
  const prompts = $("prompt").value.split("\n").map((line) => line.trim()).filter(Boolean);
  for (const prompt of prompts.length ? prompts : [""])
    ask({ do: "start", words: words(prompt), label: prompt || (file ? file.name : $("choice").selectedOptions[0].text) });
  if (idle) ask({ do: "show" });
}

/** Fill the form from the words of a command. */
function again(given) {
  $("form").reset();
  setFile(null);
  const configs = [], more = [], keys = Object.fromEntries(Object.entries(FIELDS).map(([key, option]) => [option, key]));
  for (let i = given.indexOf("--config"); i >= 0 && i < given.length; i++) {
    const [option, ...rest] = given[i].split("="), value = rest.join("=");
    if (given[i] === "--config") configs.push(given[++i]);
    else if (option in keys) $(keys[option]).value = value;
    else if (option === MESH || option === `${PRIOR}.path`)
      setFile({ path: value, name: value.split("/").pop(), gaussians: given.includes(`${PRIOR}_type=gaussians-prior`) });
    else if (![`${PRIOR}_type`, `${PRIOR}.num_points`, "exp_root_dir", "--train"].includes(option)) more.push(given[i]);
  }
  const name = configs.join(" ");
  if (![...$("choice").options].some((option) => option.value === name)) $("choice").append(make("option", { value: name }, name));
  $("choice").value = name;
  showDefaults();
  $("more").value = more.map((word) => (/[\s"']/.test(word) ? `'${word.replaceAll("'", `'"'"'`)}'` : word)).join(" ");
  $("prompt").focus();
}

function setFile(found) {
  file = found;
  $("uploaded").hidden = !found;
  $("file").textContent = found ? found.name : "";
  $("upload").value = "";
}

function upload(given) {
  if (given.size > about.limit) return say(`${given.name} has ${size(given.size)}; at most ${size(about.limit)} can be uploaded`);
  socket.send(new Blob([given.name.replaceAll("\n", " "), "\n", given]));
  say(`${given.name} is being sent ...`);
  sending = given.name;
}

// ---- what is at work ----------------------------------------------------------------------------

/** Return whether what a name stands for has changed since the last call, so that no button goes while it is pressed. */
function isChanged(name, value) {
  const text = JSON.stringify(value), same = isChanged[name] === text;
  isChanged[name] = text;
  return !same;
}

/** Return the lines of a command's output, without its progress bars. */
function linesOf(job) {
  const lines = job.text.split("\n").map((line) => line.split("\r").pop().trimEnd());
  return lines.filter((line) => line && !PROGRESS.test(line));
}

/** Return the message that a command has ended with; "" if it has succeeded or was stopped. */
function errorOf(job) {
  if ([null, 0, ...STOPPED].includes(job.code)) return "";
  const lines = linesOf(job), at = lines.findLastIndex((line) => line.startsWith("error: "));
  if (at >= 0) return lines.slice(at).join("\n");
  const how = job.code < 0 ? `signal ${-job.code}${job.code === -9 ? " (out of memory?)" : ""}` : `exit code ${job.code}`;
  return [`the process has failed: ${how}`, ...lines.slice(-4)].join("\n");
}

function caption(place) {
  const count = state.counts[place], id = state.shown[place];
  if (!count) return "";
  const run = shelf.find((one) => one.id === id);
  const name = run ? run.prompt : id ? id.split("/").pop() : state.grown;
  return `${isolated(name)}: ${count.toLocaleString("en")} Gaussians`;
}

const reported = new Set(), advice = {};

function showState() {
  const { job, last, queue, tool, last_tool: lastTool } = state, now = job || last;
  $("pause").disabled = $("stop").disabled = !job;
  $("pause").textContent = job && job.paused ? "Go on" : "Pause";
  $("run").hidden = !job;
  if (job) {
    const { stage, step, steps, count, dB, likeness, left, pictures } = job.status;
    $("what").textContent = `${isolated(job.label)}: ${job.paused ? "paused" : stage || "starting"}`;
    $("progress").value = step ? step / steps : 0;
    $("numbers").textContent = [
      step !== undefined && `step ${step} of ${steps}`,
      count && `${count.toLocaleString("en")} Gaussians`,
      Number.isFinite(dB) && `${dB.toFixed(1)} dB to the object`,
      Number.isFinite(likeness) && `${likeness.toFixed(1)} dB likeness to the 2D model's picture`,
      Number.isFinite(left) && `${Math.ceil(left)} s left`,
    ].filter(Boolean).join(" · ");
    // which the end of the output doesn't hold for long
    advice[job.id] ||= linesOf(job).filter((line) => /wasn't trained on/.test(line)).join("\n");
    $("advice").textContent = advice[job.id];
    $("beside-2d").hidden = !pictures;
    if (pictures && $("picture").dataset.number !== `${job.id} ${pictures}`) {
      $("picture").dataset.number = `${job.id} ${pictures}`;
      $("picture").src = `picture?${job.id}.${pictures}`;
    }
  }
  $("lines").textContent = now ? linesOf(now).join("\n") : "";
  for (const ended of [last, lastTool])
    if (ended && !reported.has(ended.id)) {
      reported.add(ended.id);
      if (errorOf(ended)) say(`${ended.label}: ${errorOf(ended)}`);
    }
  $("tool").textContent = tool ? `${tool.label} ...` : "";
  $("waiting").hidden = !queue.length;
  if (isChanged("queue", queue))
    $("queue").replaceChildren(...queue.map(({ id, label }) =>
      make("li", {}, `${isolated(label)} `, make("button", { onclick: () => ask({ do: "remove", number: id }), ariaLabel: "Remove from the queue" }, "×"))));
  $("hint").textContent = state.counts.main ? "" : job ? "The first points appear in a few seconds." : "Type a prompt and press Start. It takes shape here.";
  for (const place of ["main", "beside"]) $(`caption-${place}`).textContent = caption(place);
  for (const card of $("cards").children) card.classList.toggle("on", [state.shown.main, state.shown.beside].includes(card.dataset.id));
}

// ---- the shelf ----------------------------------------------------------------------------------

function showShelf() {
  const wanted = $("filter").value.toLowerCase();
  const found = shelf.filter((run) => run.prompt.toLowerCase().includes(wanted));
  $("cards").replaceChildren(...found.slice(0, 200).map(card));
  const rest = found.length - 200;
  $("none").textContent = rest > 0 ? `${rest} older runs: filter them.` : found.length ? "" : wanted ? "No run has this in its prompt." : "Finished runs appear here.";
  if (chosen) {
    const now = shelf.find((run) => run.id === chosen.id) || null;
    if (isChanged("chosen", [now, shelf.length])) choose(now);
  }
  else if (showShelf.newest !== undefined && shelf.length && shelf[0].id !== showShelf.newest) choose(shelf[0]);
  showShelf.newest = shelf.length ? shelf[0].id : "";
  if (state) showState();
}

function card(run) {
  const picture = make("img", { loading: "lazy", alt: "" }), still = run.picture ? address(run.picture) : "";
  if (still) picture.src = still;
  const turn = () => { if (run.turn.length) picture.src = address(run.turn[0]); }, rest = () => { picture.src = still; };
  const facts = [run.count && `${run.count.toLocaleString("en")} Gaussians`, Number.isFinite(run.scores.psnr) && `${run.scores.psnr.toFixed(1)} dB`, !run.ended && "not finished"];
  const button = make("button", { className: "card", onclick: () => { choose(run); if (run.ended) ask({ do: "show", main: run.id }); } },
    picture, make("span", {}, run.prompt), make("span", {}, make("small", {}, facts.filter(Boolean).join(" · "))));
  Object.assign(button, { onmouseenter: turn, onfocus: turn, onmouseleave: rest, onblur: rest });
  button.dataset.id = run.id;
  return button;
}

function choose(run) {
  chosen = run;
  $("chosen").hidden = !run;
  if (!run) return;
  const button = (text, onclick) => make("button", { onclick }, text);
  const others = make("select", { ariaLabel: "Run to compare with" }, ...shelf.filter((other) => other.ended && other !== run)
    .map((other) => make("option", { value: other.id }, `${other.prompt} ${other.when.slice(0, 16)}`.slice(-100))));
  const budget = make("select", { ariaLabel: "Budget" }, ...Object.entries(BUDGETS).map(([value, text]) => make("option", { value }, text)));
  const value = make("input", { value: "40", size: 6, ariaLabel: "Value of the budget" });
  budget.onchange = () => { value.value = { psnr: "40", auto: "0.5", count: "1000", bytes: "100kB" }[budget.value]; };
  const copy = (text) => make("button", { onclick: (event) => navigator.clipboard.writeText(text).then(() => { event.target.textContent = "Copied"; }) }, "Copy");
  const taken = ["gaussians.spz", "gaussians.sog", "gaussians.glb", "mesh.glb"].filter((name) => !run.files.some((known) => known.name === name));
  const scores = Object.entries(run.scores).filter(([, score]) => typeof score === "number").map(([name, score]) => `${name} ${+score.toPrecision(5)}`);
  $("chosen").replaceChildren(
    make("h2", {}, run.prompt),
    make("p", {}, make("small", {}, [run.when.slice(0, 16).replace("T", " "), ...scores].join(" · "))),
    make("p", { className: "buttons" }, button("Again with this changed", () => again(split(run.command))),
      run.resume ? button("Go on from its checkpoint", () => {
        const given = split(run.resume);
        ask({ do: "start", words: given.slice(given.indexOf("--config")), label: run.prompt });
      }) : null,
      button("Delete ...", () => remove(run))),
    run.ended && others.length ? make("p", { className: "buttons" }, button("Compare with", () => ask({ do: "show", main: run.id, beside: others.value || null })), others) : "",
    run.ended ? make("p", { className: "buttons" }, button("Prune to", () => ask({ do: "prune", run: run.id, budget: budget.value, value: value.value })), budget, value) : "",
    run.ended ? make("p", { className: "buttons" }, ...taken.map((name) => button(`Make ${name}`, () => ask({ do: "take", run: run.id, name })))) : "",
    make("ul", { className: "files" }, ...run.files.map(({ name, path, size: bytes }) =>
      make("li", {}, make("a", { href: address(path), target: "_blank", ...(name.endsWith(".html") ? {} : { download: name }) }, name), ` ${size(bytes)}`,
        /\/pruned\/.*\.(ply|spz)$/.test(path) ? button("beside", () => ask({ do: "show", main: run.id, beside: path })) : null))),
    make("details", {}, make("summary", {}, "The command that repeats it"), make("pre", {}, run.command), copy(run.command)),
    make("details", {}, make("summary", {}, "Settings that differ"), make("pre", {}, run.settings.join("\n"))),
  );
}

function remove(run) {
  $("question").textContent = `Delete ${run.id}?`;
  $("ask").returnValue = "";
  $("ask").onclose = () => { if ($("ask").returnValue === "yes") ask({ do: "delete", run: run.id }); };
  $("ask").showModal();
}

// ---- start --------------------------------------------------------------------------------------

const dark = matchMedia("(prefers-color-scheme: dark)");
const paint = () => { $("scene").src = "index.html" + (dark.matches ? "?darkMode" : ""); };
dark.onchange = paint;
paint();
// viser's own panel has nothing to show here, and its note about software drawing covers the view
$("scene").onload = () => $("scene").contentDocument.head.append(make("style", {}, "[class*=mantine-Paper-root], [class*=mantine-Notification] { display: none !important; }"));
$("form").onsubmit = (event) => { event.preventDefault(); start(); };
$("form").onkeydown = (event) => { if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) { event.preventDefault(); start(); } };
$("pause").onclick = () => ask({ do: "control", paused: !state.job.paused });
$("stop").onclick = () => ask({ do: "control", stop: true });
$("clear").onclick = () => ask({ do: "remove" });
$("refresh").onclick = () => ask({ do: "refresh" });
$("grow").onclick = () => ask({ do: "show" });
$("filter").oninput = showShelf;
$("upload").onchange = () => { if ($("upload").files.length) upload($("upload").files[0]); };
$("choice").onchange = showDefaults;
$("forget").onclick = () => setFile(null);
connect();
