// The page of runs, of a comparison and of a sweep: what the JSON in it holds, as tables, plots and pictures.
const data = JSON.parse(document.getElementById("data").textContent);
const runs = data.runs ?? [], several = runs.length > 1, split = data.split ?? "";

// ---- values of runs

const kSample = "_sample";
const kTexts = {inf: Infinity, "-inf": -Infinity, nan: NaN};
/** A value of a row of metrics.jsonl, or null. */
const get = (row, key) => (row && Object.hasOwn(row, key) ? kTexts[row[key]] ?? row[key] : null);
const kMetrics = [  // in the order of the table; digits; 1: larger is better, -1: smaller
  ["miou", "mIoU", "", 4, 1, "mean over classes with a non-empty union"],
  ["miou_present", "mIoU (present)", "", 4, 1, "mean over classes that occur in truth"],
  ["total_accuracy", "Total accuracy", "", 4, 1, "share of pixels with the right class"],
  ["average_accuracy", "Average accuracy", "", 4, 1, "mean recall over classes in truth"],
  ["psnr", "PSNR", "dB", 4, 1, "from the squared error pooled over the split"],
  ["psnr_fitted_colors", "PSNR, colours fitted", "dB", 4, 1,
    "each half of a frame under the map of colours that fits the other half"],
  ["psnr_refined_poses", "PSNR, poses fitted", "dB", 4, 1, "each frame from the pose that fits the field"],
  ["ssim", "SSIM", "", 4, 1, "mean over images"],
  ["absrel", "AbsRel", "", 3, -1, "depth: mean |error| / truth"],
  ["absdiff", "AbsDiff", "m", 3, -1, "depth: mean |error|"],
  ["sqrel", "SqRel", "m", 3, -1, "depth: mean error² / truth"],
  ["rmse", "RMSE", "m", 3, -1, "depth"],
  ["delta1", "δ < 1.25", "", 4, 1, "depth: share of pixels within that factor"],
  ["delta2", "δ < 1.25²", "", 4, 1, "depth: share of pixels within that factor"],
  ["delta3", "δ < 1.25³", "", 4, 1, "depth: share of pixels within that factor"],
  ["depth_coverage", "Depth coverage", "", 4, 1, "share of valid truth with a prediction"],
  ["under_resolved", "Under-resolved", "", 3, -1, "share of opaque pixels whose opacity came in one or two long steps"],
  ["ece", "ECE", "", 3, -1, "expected calibration error, 15 bins"],
  ["nll", "NLL", "nats", 3, -1, "of the true class, a pixel"],
  ["entropy_auroc", "Entropy AUROC", "", 3, 1, "entropy as a detector of wrong pixels; 0.5 is chance"],
  ["rays_per_s", "Rays per second", "", 3, 1, "last training row"],
  ["samples_per_ray", "Samples per ray", "", 3, 0, "last training row"],
  ["loss", "Training loss", "", 3, 0, "last training row"],
].map(([key, label, unit, digits, better, help]) => ({key, label, unit, digits, better, help}));
const metric_of = (key) => kMetrics.find((metric) => metric.key === key);

/** "4 of 30 frames at 1 pixel in 4" where the row is of a part of its split, else "". */
function sample_text(row) {
  if (!row?.split?.endsWith(kSample)) return "";
  const [frames, all, stride] = ["frames", "split_frames", "pixel_stride"].map((key) => get(row, key));
  if (frames === null) return "some frames";
  if (all === null) return `${frames} frames`;  // of versions that did not write it
  return (frames === all ? `all ${all} frames` : `${frames} of ${all} frames`) +
    (stride > 1 ? ` at 1 pixel in ${stride * stride}` : "");
}
/** What a row scored: "all 30 frames", "a sample, 4 of 30 frames"; "" where it does not say. */
function part_text(row) {
  const sample = sample_text(row), frames = get(row, "frames");
  return sample ? `a sample, ${sample}` : frames === null ? "" : `all ${frames} frames`;
}
/** Evaluations that count: those of the part of the split that was scored last. */
function eval_rows(run, of = split) {
  const rows = run.rows.filter((row) => row.kind === "eval" && (!of || row.split === of || row.split === of + kSample));
  const last = rows.at(-1);
  return rows.filter((row) => row.split === last.split && sample_text(row) === sample_text(last));
}
const last_row = (run) => eval_rows(run).at(-1);
const last_value = (run, key, of = split) => get(eval_rows(run, of).findLast((row) => get(row, key) !== null), key);
/** Evaluations that a curve goes through: those of one sample of frames, or else those that the figures are of. */
function curve_rows(run) {
  const rows = run.rows.filter((row) => row.kind === "eval" && row.split === split + kSample);
  const same = rows.filter((row) => sample_text(row) === sample_text(rows[0]));
  return same.length < 2 ? eval_rows(run) : same;
}
const largest = (run, key) => run.rows.reduce((most, row) => Math.max(most, get(row, key) ?? 0), 0);
const trained_s = (run) => largest(run, "train_s");
const fact = (run, name) => run.environment.find(([key]) => key === name)?.[1] ?? "";

/** Names of the runs by a value of theirs; those without one are in no group. */
function grouped(value_of) {
  const groups = new Map();
  for (const run of runs) {
    const value = value_of(run);
    if (value) groups.set(value, [...(groups.get(value) ?? []), run.name]);
  }
  return [...groups];
}
/** Why figures of these runs cannot be ranked, a sentence each. */
function reasons_against_ranking() {
  const listed = (groups, told) => groups.map(([value, names]) => names.join(", ") + told(value, names)).join("; ");
  const scene_of = (_, [name]) => {
    const {scene} = runs.find((run) => run.name === name);
    return scene ? ` on ${scene}` : "";
  };
  const on = (value) => ` on ${value.split("\n")[0]}`;
  const inputs = grouped((run) => fact(run, "input_hash"));
  // Other data have another number of frames; that is no reason of its own.
  const is_whole = (run) => inputs.length > 1 && last_row(run) && !sample_text(last_row(run));
  const parts = grouped((run) => (is_whole(run) ? "all frames" : part_text(last_row(run))));
  const frames = grouped((run) => run.eval?.per_frame.map(({frame}) => frame).join("\n"));
  const pixels = grouped((run) => get(last_row(run), "pixels")?.toFixed(0));
  const reasons = [];
  if (inputs.length > 1)
    reasons.push("they read different data (another scene, or other frames or sizes of one): " +
      listed(inputs, scene_of));
  if (parts.length > 1)
    reasons.push("their last evaluations scored other parts of the split: " + listed(parts, (value) => ` ${value}`));
  else if (inputs.length < 2 && frames.length > 1)
    reasons.push("they were scored on other frames: " + listed(frames, (value) => `${on(value)} and others`));
  else if (inputs.length < 2 && pixels.length > 1)
    reasons.push("they were scored on other pixels: " + listed(pixels, on));
  return reasons;
}
const unranked = reasons_against_ranking(), ranked = unranked.length === 0;

/** Index of the best value; -1 where there are not two different ones. */
function best_of(values, better) {
  const known = values.filter((value) => value !== null && !Number.isNaN(value));
  if (!better || new Set(known).size < 2) return -1;
  return values.indexOf(better > 0 ? Math.max(...known) : Math.min(...known));
}
/**
 * When the evaluations first reached a level: {before, at: seconds, first: at the first one, only: of one}; or null.
 */
function time_of_level(rows, {key, better}, level) {
  const known = rows.filter((row) => get(row, key) !== null);
  const i = known.findIndex((row) => better * (get(row, key) - level) >= 0);
  if (i < 0) return null;
  return {before: known[i - 1]?.train_s ?? 0, at: known[i].train_s, first: i === 0, only: rows.length === 1};
}
/** Index of the run that came first for certain, or -1. */
const first_for_certain = (times) => times.length < 2 ? -1 : times.findIndex((one, i) => one &&
  times.every((other, j) => i === j || (other && one.at <= other.before)));

// ---- pieces of the page

const two = (n) => String(n).padStart(2, "0");
function duration(seconds) {
  if (seconds < 100) return `${figure(seconds, 3)} s`;
  const s = Math.round(seconds), m = Math.floor(s / 60);
  return s < 3600 ? `${m} min ${two(s % 60)} s` : `${Math.floor(m / 60)} h ${two(m % 60)} min`;
}
const percent = (share) =>
  share > 0 && share < 0.001 ? "under 0.1 %" : `${(100 * share).toFixed(share > 0 && share < 0.01 ? 1 : 0)} %`;
const count = (n) => n.toLocaleString("en-US");
const counted = (n, what) => `${count(n)} ${what}${n === 1 ? "" : "s"}`;
const ratio = (part, whole) => (whole > 0 ? part / whole : 0);
const sum = (numbers) => numbers.reduce((all, one) => all + one, 0);

const small = (text) => text && html`<small class="d">${text}</small>`;
const grey = (text) => html`<span class="none">${text}</span>`;
/** What stands between backticks is code. */
const words = (text) => String(text).split("`").map((part, i) => (i % 2 > 0 ? html`<code>${part}</code>` : part));
const hint = (...text) => html`<p class="hint after">${text.filter((one) => one).flatMap(words)}</p>`;
const swatch = (color) => html`<span class="sw" style="background:rgb(${color.join(" ")})"></span>`;
const head = (name, more, kind = "num") => html`<th scope="col" class="${kind}">${name}${small(more)}</th>`;
const text_head = (name) => head(name, "", "");
const cell = (text, more) => html`<td class="num">${text}${small(more)}</td>`;
const value_cell = (value, digits, is_best) => value === null ?
  html`<td class="num none">–</td>` :
  html`<td class="num${is_best && " best"}">${figure(value, digits)}</td>`;
/** Cells are Html, or texts of cells. */
const row = (name, cells) => html`<tr><th scope="row">${name}</th>${
  [cells].flat(9).map((one) => (one instanceof Html ? one : cell(one)))}</tr>`;
/** columns: a name, [name, more], or Html of a head. */
const table = (label, first, columns, rows, kind = "panel ") => html`<div class="${kind}scroll" tabindex="0" role="region"
aria-label="${label}"><table style="--n:${columns.length}"><thead><tr>${text_head(first)}${
  columns.map((one) => (one instanceof Html ? one : head(...[one].flat())))}</tr></thead><tbody>${
  rows}</tbody></table></div>`;
const details = (title, ...parts) => html`<details><summary>${title}</summary>${parts}</details>`;
const panel = (title, note, ...parts) =>
  html`<figure class="panel"><figcaption>${title}<span>${note}</span></figcaption>${parts}</figure>`;
const section = (id, title, sentence, ...parts) => html`<section id="${id}" aria-labelledby="${id}-h"><h2
id="${id}-h">${title}</h2>${sentence && html`<p class="hint">${sentence}</p>`}${parts}</section>`;
/** A column for each run, so that a page of one run is narrow. */
const by_run = (label, first, rows, some = runs) => table(label, first, some.map(({name}) => name), rows);
const legend = (names = several ? runs.map(({name}) => name) : []) =>
  names.length > 0 && html`<ul class="legend">${names.map((name, i) => html`<li>${line_sample(i)}${name}</li>`)}</ul>`;
const of_run = (run) => several && `: ${run.name}`;
const of_first = several ? ` Pictures are of ${runs[0].name}.` : "";
/** Names the runs for which something is missing; the sentence ends before the names. */
function missing(sentence, is_missing) {
  const names = runs.filter(is_missing).map(({name}) => name);
  return names.length > 0 && hint(`${sentence} ${names.join(", ")}.`);
}
const strips = (some) =>
  some.map(({name, note, images}) => html`<div class="panel strip"><h3>${name}${note && html`<span>${note}</span>`}</h3>
<div class="imgs">${images.map(({caption, png}) => html`<figure><img alt="${caption}, frame ${name}" loading="lazy"
src="${png}"><figcaption>${caption}</figcaption></figure>`)}</div></div>`);

// ---- the head: what the runs are, what to mind about them, and their largest figures

function facts_of(run) {
  const of = run.labels, last = last_row(run), version = fact(run, "version"), device = fact(run, "device");
  const labelled = of?.classes.length ? ` (${count(of.labelled_frames)} labelled)` : "";
  const held_out = split === "test" &&
    (get(last, "split_frames") ?? (sample_text(last) ? null : get(last, "frames")));
  const frames = [of && `${count(of.train_frames)} training${labelled}`, held_out && `${count(held_out)} test`];
  return {
    Scene: run.scene,
    Frames: frames.filter((text) => text).join(", "),
    Scored: part_text(last),
    Started: fact(run, "started"),
    Version: version && `Semfield ${version}`,
    Device: !device || device === "cpu" ? fact(run, "cpu") : device
  };
}
function facts() {
  const told = runs.map(facts_of);
  const names = Object.keys(told[0]).filter((name) => told.some((of) => of[name]));  // what no run states is left out
  if (!several)
    return names.length > 0 &&
      html`<dl class="facts">${names.map((name) => html`<div><dt>${name}</dt><dd>${told[0][name]}</dd></div>`)}</dl>`;
  const rows = names.map((name) => row(name, told.map((of) => html`<td>${of[name]}</td>`)));
  return html`<div class="facts">${table("Runs", "", runs.map((run) => text_head(run.name)), rows)}</div>`;
}
function notices() {
  return [
    several && !ranked && `The runs are not ranked: ${unranked.join("; ")}.`,
    runs.some((run) => sample_text(last_row(run))) && `Figures are of a sample of the split “${split}”. ` +
      "`semfield eval` scores every pixel of a run folder; then `semfield report` shows that."
  ].map((text) => text && html`<p class="notice">${words(text)}</p>`);
}
function cards() {
  const card = (label, value, unit, note) => html`<div class="card"><div class="k">${label}</div><div
class="v">${value}${unit && html`<span class="u">${unit}</span>`}</div><div class="n">${note}</div></div>`;
  const shown = several && !ranked ? [] :
    ["miou_present", "total_accuracy", "psnr", "psnr_fitted_colors", "psnr_refined_poses", "absrel"];
  const longest = runs.reduce((a, b) => (trained_s(b) > trained_s(a) ? b : a));
  return html`<div class="cards">${shown.map((key) => {
    const {label, unit, digits, better, help} = metric_of(key), values = runs.map((run) => last_value(run, key));
    const first = best_of(values, better), best = first < 0 ? values.findIndex((value) => value !== null) : first;
    if (best < 0) return "";
    return card(label, figure(values[best], digits), unit, several ? `best: ${runs[best].name}` : help);
  })}${card(several ? "Longest training" : "Training", duration(trained_s(longest)), "",
    `${several ? `${longest.name}: ` : ""}${count(largest(longest, "step"))} steps, evaluation not counted`)}</div>`;
}

// ---- figures, classes, pictures

/** The last evaluation, or the last training row for what only training knows. */
function table_value(run, key) {
  const value = last_value(run, key);
  if (value !== null || !["rays_per_s", "samples_per_ray", "loss"].includes(key)) return value;
  return get(run.rows.findLast((one) => one.kind === "train" && get(one, key) !== null), key);
}
function figures() {
  const rows = kMetrics.map(({key, label, unit, digits, better, help}) => {
    const values = runs.map((run) => table_value(run, key)), best = ranked ? best_of(values, better) : -1;
    if (values.every((value) => value === null)) return "";
    return row([label, unit && [" ", grey(unit)], small(help)],
      values.map((value, i) => value_cell(value, digits, i === best)));
  });
  rows.push(row(["Training time", small("evaluation not counted")], runs.map((run) => duration(trained_s(run)))));
  const of_split = split && ` on the split “${split}”`;
  const rank = !several ? "" : ranked ? " The best of each row is set in bold." :
                                        " The runs are not ranked; the reason is at the top.";
  const sentence = runs.some((run) => last_row(run)) ? `Last evaluation${of_split}.${rank}` :
    "No frame was scored: the scene has no test frames, or the run has not come to an evaluation.";
  return section("figures", "Figures", sentence,
    html`<div class="figures">${by_run("Figures", "Metric", rows)}</div>`);
}

function classes() {
  const of_each = runs.map((run) => eval_rows(run).findLast((one) => one.per_class_iou)?.per_class_iou ?? {});
  const names = new Set([...data.classes.map(({name}) => name), ...of_each.flatMap(Object.keys)]);
  const seen = [...names].filter((name) => of_each.some((ious) => get(ious, name) !== null));
  const bars = seen.map((name) => {
    const color = data.classes.find((one) => one.name === name)?.color ?? [128, 128, 128];
    const ious = of_each.map((of) => get(of, name));
    const bar = (iou, i) => html`<i style="width:${(100 * Math.min(1, Math.max(0, iou))).toFixed(1)}%;background:${
      several ? paint(i) : `rgb(${color.join(" ")})`}"></i>`;
    return html`<div class="bar"><span class="name">${swatch(color)}${name}</span><span>${ious.map((iou, i) =>
      html`<div class="tr">${iou !== null && bar(iou, i)}</div>`)}</span><span class="val">${ious.map((iou) =>
      html`<div>${iou === null ? grey("–") : iou.toFixed(3)}</div>`)}</span></div>`;
  });
  return bars.length > 0 && section("classes", "Intersection over union by class",
    `Bars run from 0 to 1, in the ${several ? "order and colours of the legend" : "colours of the label images"}; ` +
      "classes that no scored frame shows have none.",
    legend(), html`<div class="panel bars">${bars}</div>`);
}

function frames() {
  if (data.strips.length === 0) return "";
  const [first, ...more] = data.strips, entropy = first.images.some(({caption}) => caption === "entropy");
  const sentence = entropy ? "Entropy runs over its full range, 0 to ln C; depth is bright where near." :
                             "Depth is bright where near.";
  return section("frames", "Rendered frames", sentence + of_first, strips([first]), more.length > 0 &&
    html`<details class="panel more"><summary>${more.length} more frame${more.length > 1 && "s"}</summary>${
      strips(more)}</details>`);
}
const scene = () => data.scene &&
  section("scene", "3D", `A coarse mesh${several ? ` of ${runs[0].name}` : ""}. Drag to turn; click it first to zoom.`,
    html`<iframe loading="lazy" title="The scene in three dimensions" srcdoc="${data.scene}"></iframe>`);

const kProofs = {B: "the same bits", C: "the same within a bound", S: "the same in statistics"};
/** What the scene gave a reason for; a loss that nobody asked for is no part of it. */
function left_out() {
  const kept = new Map();  // a row that several runs have stands once, with their names
  for (const run of runs)
    for (const one of run.left_out.filter(({rule}) => rule !== "not asked for")) {
      const key = JSON.stringify(one);
      kept.set(key, [one, [...(kept.get(key)?.[1] ?? []), run.name]]);
    }
  const rows = [...kept.values()].map(([one, names]) => row(
    [one.component.replaceAll("_", " "), small(one.rule),
      several && small(names.length === runs.length ? "every run" : names.join(", "))],
    [one.evidence, one.saving_estimate, kProofs[one.proof]].map((text) => html`<td>${words(text)}</td>`)));
  return rows.length > 0 && details(`Left out, because this scene does without: ${counted(rows.length, "part")}`,
    html`<div class="left-out">${
      table("Left out", "Part", ["Found here", "Saves", "Result"].map(text_head), rows, "")}</div>`);
}
function setup() {
  const parts = runs.flatMap((run) => {
    const rows = run.environment.filter(([, value]) => value)
                   .map(([key, value]) => row(key.replaceAll("_", " "), html`<td class="code">${value}</td>`));
    return [
      run.environment.length > 0 && details(["Environment", of_run(run)],
        html`<div class="scroll"><table style="--n:1"><tbody>${rows}</tbody></table></div>`),
      run.config && details(["Configuration", of_run(run)], html`<pre tabindex="0">${run.config}</pre>`)
    ];
  }).concat(left_out()).filter((part) => part);
  return parts.length > 0 &&
    section("setup", "Set-up", "What it takes to repeat the run.", html`<div class="panel">${parts}</div>`);
}

// ---- error against the number of labels, and clicks

const has_labels = (run) => run.labels?.classes.length > 0;  // a scene without classes has none to report

/** Each run is a point of its own: what else differs between runs is not known here, so no line joins them. */
function label_plots() {
  const counts = runs.filter(has_labels).map((run) => run.labels.labelled_pixels), least = Math.min(...counts);
  const log_x = least > 0 && Math.max(...counts) >= 10 * least;
  return ["miou", "total_accuracy"].map((key) => {
    const point = (run) => ({x: run.labels?.labelled_pixels, y: last_value(run, key)});
    const series = runs.map((run, color) => ({name: run.name, color, points: [point(run)]}))
                     .filter(({points: [{y}]}, i) => has_labels(runs[i]) && y !== null);
    const title = metric_of(key).label;
    return series.length > 0 && panel(title, log_x ? "logarithmic number of labels" : "higher is better",
      plot({title, x_label: "labelled pixels in training", markers: true, log_x, series}));
  });
}
/** A value of training frames in each run; nothing where none has it. */
function value_row(name, key, digits, some = runs) {
  const values = some.map((run) => last_value(run, key, "train"));
  return values.some((value) => value !== null) && row(name, values.map((value) => value_cell(value, digits)));
}
function labels() {
  const known = runs.filter(has_labels);
  if (known.length === 0) return "";
  const of_all = ({labels: of}) => `${percent(ratio(of.labelled_pixels, of.train_pixels))} of all`;
  const rows = [
    row("Labelled frames", known.map(({labels: of}) => `${count(of.labelled_frames)} of ${count(of.train_frames)}`)),
    row("Labelled pixels", known.map((run) => cell(count(run.labels.labelled_pixels), of_all(run)))),
    row("Classes with labels", known.map(({labels: {classes: all}}) =>
      `${all.filter(({pixels}) => pixels > 0).length} of ${all.length}`)),
    known.some(({labels: of}) => of.degrade.length > 0) &&
      row("Made worse by", known.map(({labels: of}) => of.degrade.map(({type}) => type).join(", "))),
    // Of runs with report.training_frames: what the labels were worth, and what was made of them.
    value_row(["mIoU of the labels", small("against the scene’s own")], "given_miou", 4, known),
    value_row(["mIoU at their poses", small("of the field")], "miou", 4, known)
  ];
  const steps = runs.flatMap((run) => (run.labels?.degrade ?? []).map((step) => [run.name, step]));
  const told = steps.filter(([, {facts}]) => Object.keys(facts).length > 0).map(([name, {type, facts}]) =>
    hint(`${name}, ${type}: ${Object.entries(facts).map((one) => one.join(" ")).join(", ")}.`));
  const rounds = runs.flatMap((run) => run.rounds.map((text) => hint(`${run.name}, ${text}.`)));
  const plots = known.length > 1 && ranked ? label_plots() : [];
  const [title, sentence] = known.length > 1 ?
    ["Error against number of labels",
      "One point for each run, at its last evaluation; runs may differ in more than their labels."] :
    ["Labels in training", "What the semantic head learned from."];
  return section("labels", title, sentence,
    plots.some((one) => one) && [legend(), html`<div class="plots">${plots}</div>`],
    by_run("Labels of each run", "", rows, known),
    told, rounds,
    missing("Left out, because their folders hold no labels.json (made by an older version):", (run) => !run.labels),
    missing("Left out, because their scenes have no classes:", (run) => run.labels && !has_labels(run)));
}
function clicks() {
  const tables = runs.filter(({clicked}) => clicked).map(({name, clicked: of}) => [
    hint(several && `${name}: `,
      `${counted(of.clicks, "click")} in ${count(of.clicked_frames)} of ${count(of.frames)} frames, at step ${
        count(of.step)}.`),
    table("Classes of the clicks", "Class", ["Clicks", "Surface", "Sure"], of.classes.map((one) =>
      row([swatch(one.color), " ", one.name, grey(` ${one.id}`)],
        [count(one.clicks), percent(one.area_share), percent(one.confidence)])))
  ]);
  return tables.length > 0 && section("clicks", "Clicks",
    "What was named on the labelling page. Surface: share of what the views show; sure: mean probability of " +
      "the class there.",
    tables, data.clicked.length > 0 &&
      [hint("Frames with the most clicks, which are drawn on the photographs.", of_first), strips(data.clicked)]);
}

// ---- what the final evaluation says beside figures

const kNoDetail = "Left out, because their folders hold no final_eval.json (made by an older version, or not ended):";
const without_detail = () => missing(kNoDetail, (run) => !run.eval);
const kMostClasses = 64, kMostConfusions = 5;  // of a table that can still be read
const px_text = (pixels) => `${count(pixels)} px`;

function confusions_of({classes: all, confusion: {pixels}}) {
  const truth = pixels.map(sum), predicted = pixels.map((_, p) => sum(pixels.map((of) => of[p])));
  const found = pixels.flatMap((of, t) => of.map((n, p) => ({t, p, n, share: ratio(n, truth[t])})))
                  .filter(({t, p, n}) => t !== p && n > 0);
  const wrong = sum(found.map(({n}) => n));
  const read_as = ({t, p, n, share}) => html`<li>${swatch(all[t].color)}${all[t].name} read as ${
    swatch(all[p].color)}${all[p].name}: ${percent(share)} of ${all[t].name}${
    small(`${px_text(n)}, ${percent(ratio(n, wrong))} of all wrong pixels`)}</li>`;
  // Twice: those that cost most pixels are of large classes, those that hide a class of small ones.
  const list = (title, key) => html`<div><h4>${title}</h4><ul>${
    [...found].sort((a, b) => b[key] - a[key] || b.n - a.n).slice(0, kMostConfusions).map(read_as)}</ul></div>`;
  const seen = all.map((_, i) => i).filter((i) => truth[i] + predicted[i] > 0);
  const shown = [...seen].sort((a, b) => truth[b] + predicted[b] - truth[a] - predicted[a])
                  .slice(0, kMostClasses).sort((a, b) => a - b);
  const one = (t, p) => {
    const n = pixels[t][p], share = ratio(n, truth[t]);
    if (n === 0) return html`<td></td>`;
    // The root shows small fractions; half of full colour keeps the figures legible.
    return html`<td class="${t === p ? "ok" : "no"}" style="--p:${(60 * Math.sqrt(share)).toFixed(0)}%"
title="${all[t].name} read as ${all[p].name}: ${percent(share)} of ${all[t].name}, ${px_text(n)}">${
      share < 0.005 ? "·" : (100 * share).toFixed(0)}</td>`;
  };
  // A class that is read, but never true, is a column alone.
  const rows = shown.filter((t) => truth[t] > 0).map((t) => html`<tr><th scope="row" class="row"
title="${all[t].name}">${swatch(all[t].color)}${grey(all[t].id)}
${all[t].name}</th>${shown.map((p) => one(t, p))}${cell(count(truth[t]))}</tr>`);
  return [
    found.length === 0 ? html`<p class="hint">Every scored pixel has its class.</p>` :
      html`<div class="words">${list("Most pixels", "n")}${list("Largest share of a class", "share")}</div>`,
    html`<div class="scroll" tabindex="0" role="region" aria-label="Confusion matrix"><table
class="cm" style="--n:${shown.length}"><thead><tr><th scope="col"
class="row">truth ↓ read as →</th>${
      shown.map((p) => html`<th scope="col" title="${all[p].name}"><span class="v">${swatch(all[p].color)}${all[p].id}
${all[p].name}</span></th>`)}${head("pixels")}</tr></thead><tbody>${rows}</tbody></table></div>`,
    shown.length < seen.length &&
      hint(`The ${shown.length} of ${seen.length} classes with the most pixels; \`semfield eval --json\` prints all.`)
  ];
}
function confusions() {
  const some = runs.filter((run) => run.eval?.confusion.pixels.flat().some((n) => n > 0));
  const of_one = (run, i) => several ?
    html`<details ${i === 0 && "open"}><summary>${run.name}</summary>${confusions_of(run.eval)}</details>` :
    html`<div class="pad">${confusions_of(run.eval)}</div>`;
  return some.length > 0 && section("confusion", "Confusions",
    "Which classes are taken for which, over all pixels of the last evaluation. A row holds all pixels of a " +
      "true class and sums to 100 %; “·” is less than half a per cent.",
    html`<div class="panel">${some.map(of_one)}</div>`, without_detail());
}

function reliability(run, color) {
  const {bins, nonfinite_pixels: lost} = run.eval.reliability, all = sum(bins.map(({pixels}) => pixels));
  const held = bins.map((bin, i) => ({...bin, range: [i, i + 1].map((k) => k / bins.length)}))
                 .filter(({pixels}) => pixels > 0);
  const mean = (value_of) => sum(held.map((bin) => bin.pixels * value_of(bin))) / Math.max(1, all);
  const ece = all > 0 && !lost ? mean(({accuracy, confidence}) => Math.abs(accuracy - confidence)) : null;
  const sure = mean(({confidence}) => confidence), right = mean(({accuracy}) => accuracy), lean = sure - right;
  const auroc = run.eval.entropy?.auroc ?? null;
  const to_text = (range) => range.map((v) => v.toFixed(2)).join(" to ");
  const bars = held.map(({range, pixels, accuracy}) => ({
    from: range[0], to: range[1], height: ratio(pixels, all),
    text: `confidence ${to_text(range)}: ${percent(ratio(pixels, all))} of the pixels, accuracy ${accuracy.toFixed(3)}`
  }));
  const points = held.map(({confidence: x, accuracy: y}) => ({x, y}));
  const perfect = {name: "perfect calibration", color: 0, points: [{x: 0, y: 0}, {x: 1, y: 1}], reference: true};
  const drawn = plot({title: "Accuracy", x_label: "confidence", markers: true, end_values: false, x_range: [0, 1],
    y_range: [0, 1], series: [{name: run.name, color, points, bars}, perfect]});
  const told = Math.abs(lean) >= 0.0005 &&
    `: ${lean > 0 ? "over-confident" : "under-confident"} by ${Math.abs(lean).toFixed(3)}`;
  const rows = held.map(({range, pixels, confidence, accuracy}) => row(to_text(range), [count(pixels),
    percent(ratio(pixels, all)), confidence.toFixed(3), accuracy.toFixed(3),
    figure(Math.round(1000 * (accuracy - confidence)) / 1000, 3)]));
  return panel(run.name,
    ece === null ? `no ECE: ${px_text(lost)} without finite probabilities` : `ECE ${figure(ece, 3)}`, drawn,
    html`<p class="hint note">Mean confidence ${sure.toFixed(3)}, accuracy ${right.toFixed(3)}${told}.${
      auroc !== null && ` AUROC ${figure(auroc, 3)}: in ${percent(auroc)} of all pairs of a wrong and a right pixel ` +
        "the wrong one has the higher entropy."}</p>`,
    details("Bins", table("Reliability bins", "Confidence",
      ["Pixels", "Share", "Mean confidence", "Accuracy", "Accuracy − confidence"], rows, "")));
}
/** Entropy at training poses by what the label was worth, of runs with report.training_frames. */
function given_table() {
  const rows = [
    ["Labelled rightly", "mean entropy, nats", "given_right_entropy"],
    ["Labelled wrongly", "mean entropy, nats", "given_wrong_entropy"],
    ["Unlabelled", "mean entropy, nats", "given_none_entropy"],
    ["Wrong against right", "AUROC of entropy", "given_wrong_auroc"],
    ["Unlabelled against labelled", "AUROC of entropy", "given_none_auroc"]
  ].map(([name, more, key]) => value_row([name, small(more)], key, 3)).filter((one) => one);
  return rows.length > 0 && [
    hint("Entropy of the pixels of training frames, by the label that they were given. An AUROC of 0.5 is chance; 1 " +
      "means that entropy separates the two groups."),
    by_run("Entropy by the label given", "", rows)
  ];
}
function calibration() {
  const plots = runs.map((run, i) => run.eval?.reliability.bins.length > 0 && reliability(run, i));
  const given = given_table();
  return (given || plots.some((one) => one)) && section("calibration", "Calibration",
    "Does a class with probability 0.8 turn out right in 80 % of the cases? Dots: share of right pixels over " +
      "mean confidence, in 15 bins; on the dotted line it is as sure as it is right, " +
      "below it too sure. Bars: share of all pixels that a bin holds. ECE is the mean distance from the line, " +
      "weighted by pixels. AUROC says how well entropy finds wrong pixels: 0.5 is chance, " +
      "1 is all wrong pixels above all right ones.",
    html`<div class="plots">${plots}</div>`, given, without_detail());
}

function worst() {
  // Worst first; frames without a mIoU after those with one, by PSNR.
  const rank = (frame) => [get(frame, "miou_present") ?? 2, get(frame, "psnr") ?? Infinity];
  const compared = (a, b) => (a < b ? -1 : a > b ? 1 : 0);
  const sorted = (all) =>
    [...all].sort((a, b) => compared(rank(a)[0], rank(b)[0]) || compared(rank(a)[1], rank(b)[1]));
  const tables = runs.filter((run) => run.eval?.per_frame.length > 0).map((run) => {
    const all = sorted(run.eval.per_frame);
    const known = ["miou_present", "psnr", "absrel"].map(metric_of)
                    .filter(({key}) => all.some((frame) => get(frame, key) !== null));
    return details([`Scores of all ${all.length} frames`, of_run(run)],
      table("Scores of frames", "Frame", known.map(({label, unit}) => label + (unit && `, ${unit}`)),
        all.map((frame) => row(frame.frame, known.map(({key, digits}) => value_cell(get(frame, key), digits)))), ""));
  });
  return data.worst.length + tables.length > 0 && section("worst", "Worst frames",
    data.worst.length > 0 && `The frames with the lowest scores, worst first.${of_first}`, strips(data.worst),
    tables.length > 0 && html`<div class="panel below">${tables}</div>`);
}

// ---- error against run time

const kCurves = [
  {key: "loss", title: "Training loss", note: "logarithmic", trains: true, log_y: true},
  {key: "psnr", title: "PSNR", note: "dB, higher is better"},
  {key: "miou_present", title: "mIoU (present)", note: "higher is better"},
  {key: "absrel", title: "Depth AbsRel", note: "logarithmic, lower is better", log_y: true}
];
/** One for each term of the list `losses` too. */
function all_curves() {
  const terms = new Set(runs.flatMap((run) => run.rows.filter(({kind}) => kind === "train").flatMap(Object.keys))
    .filter((key) => key.startsWith("loss_") && key !== "loss_color" && key !== "loss_semantic"));
  const note = "logarithmic, before its weight";
  return [...kCurves, ...[...terms].map((key) => ({...kCurves[0], key, title: `Loss: ${key.slice(5)}`, note}))];
}
/** Values over seconds of training. */
const points_of = (run, {key, trains}) => (trains ? run.rows.filter(({kind}) => kind === "train") : curve_rows(run))
  .map((one) => ({x: get(one, "train_s"), y: get(one, key)})).filter(({y}) => Number.isFinite(y));

/** The score of the page, apart from the line where that is of another part of the split. */
function end_of(run, {key, trains}) {
  const last = last_row(run), line = curve_rows(run).at(-1);
  return !trains && part_text(last) !== part_text(line) && get(last, key) !== null &&
    {x: get(last, "train_s"), y: get(last, key)};
}
/** What lines and dots are of. */
function parts_sentence() {
  const parts = runs.map((run) => [run.name, part_text(curve_rows(run)[0])]).filter(([, part]) => part);
  const [[, first] = []] = parts, differ = parts.some(([, part]) => part !== first);
  return (differ ? ` Lines are of different parts of the split (${parts.map((one) => one.join(": ")).join("; ")}).` :
    runs.some((run) => sample_text(curve_rows(run)[0])) ? ` Lines are of ${first}.` : "") +
    (runs.some((run) => kCurves.some((curve) => end_of(run, curve))) ? " A large dot is the score in “Figures”." : "");
}
function curve_plots(unit, x_label, log_x) {
  return all_curves().map((curve) => {
    const series = runs.map((run, color) => {
      const points = thinned(points_of(run, curve), 240), end = end_of(run, curve);
      return {name: run.name, color, points: points.map(({x, y}) => ({x: x / unit, y})),
        end: end && {...end, x: end.x / unit}};
    });
    const digits = curve.trains ? 3 : metric_of(curve.key).digits;
    return series.some(({points}) => points.length > 1) &&
      panel(curve.title, curve.note, plot({...curve, digits, x_label, log_x, markers: !curve.trains, series}));
  });
}
/** When each run first reached the level that the weakest ended at. */
function common_level() {
  if (!several || !ranked) return "";
  const curves = runs.map(curve_rows), [[first]] = curves;
  const same = curves.every((rows) => rows.length > 0 && first && part_text(rows[0]) === part_text(first));
  const rows_of = same ? curves : runs.map((run) => eval_rows(run));
  const time = (at, is_best) => at === null ? value_cell(null) :
    html`<td class="num${is_best && " best"}">${at.first && "≤ "}${duration(at.at)}${
      at.first && small(at.only ? "its only evaluation" : "its first evaluation")}</td>`;
  const rows = ["psnr", "miou_present", "absrel"].map(metric_of).map((metric) => {
    const {better, digits, label, unit} = metric, last = rows_of.map((rows) => get(rows.at(-1), metric.key));
    if (!last.every(Number.isFinite)) return "";
    const level = better > 0 ? Math.min(...last) : Math.max(...last);
    const times = rows_of.map((rows) => time_of_level(rows, metric, level)), best = first_for_certain(times);
    return row(`${label} ${better > 0 ? "≥" : "≤"} ${figure(level, digits)}${unit && ` ${unit}`}`,
      times.map((at, i) => time(at, i === best)));
  }).filter((one) => one);
  return rows.length > 0 && [
    html`<h3>Time to a common level</h3><p class="hint">Training time of the first evaluation at the level that every
run ended at
or beyond. A run came there between that evaluation and the one before; “≤” says that there was none before. Bold:
first for certain.</p>`,
    by_run("Time to reach a level", "Level", rows)
  ];
}
function curves() {
  const lengths = runs.map(trained_s), shortest = Math.min(...lengths), longest = Math.max(...lengths);
  const [unit, name] = longest <= 600 ? [1, "seconds"] : longest <= 3 * 3600 ? [60, "minutes"] : [3600, "hours"];
  const log_x = shortest > 0 && longest >= 10 * shortest;  // short runs are seen next to long ones
  const plots = curve_plots(unit, `${name} of training${log_x ? ", logarithmic" : ""}`, log_x), levels = common_level();
  return (levels || plots.some((one) => one)) && section("curves", "Error against run time",
    "Time is training alone; evaluation and output are not counted. The number at a line’s end is its last value." +
      parts_sentence(),
    legend(), html`<div class="plots">${plots}</div>`, levels);
}

// ---- a sweep

/** `tables`: rows of texts, the heads first; `plot`: as plot() takes it, or null. */
const experiment = ({name, title, note, scored, unequal, tables, plot: drawn}) => section(name, title, note,
  scored && hint(scored), unequal && html`<p class="notice">Not compared: ${unequal}.</p>`,
  drawn && [legend(drawn.series.map((one) => one.name)),
    html`<div class="plots">${panel(drawn.title, "", plot({...drawn, markers: true}))}</div>`],
  tables.map(([[label, ...columns], ...rows]) =>
    table(label, label, columns, rows.map(([first, ...cells]) => row(first, cells)))));

// ---- the page

function page() {
  const parts = data.experiments ? data.experiments.map((one) => [one.name, one.title, experiment(one)]) : [
    ["scene", "3D", scene()], ["frames", "Frames", frames()], ["clicks", "Clicks", clicks()],
    ["figures", "Figures", figures()], ["curves", "Error against run time", curves()], ["labels", "Labels", labels()],
    ["classes", "Classes", classes()], ["confusion", "Confusions", confusions()],
    ["calibration", "Calibration", calibration()], ["worst", "Worst frames", worst()],
    ["setup", "Set-up", setup()]
  ];
  const shown = parts.filter(([, , part]) => part);
  return html`<header class="top"><h1>${data.title}</h1>${runs.length > 0 && facts()}<nav aria-label="Sections">${
    shown.map(([id, name]) => html`<a href="#${id}">${name}</a>
`)}</nav>${runs.length > 0 && [notices(),
    cards()]}</header><main>${shown.map(([, , part]) => part)}</main><footer>Made by Semfield from the
${data.experiments ? "cells’" : "run folder’s"} files; the same files give the same bytes.</footer>`;
}
document.getElementById("page").innerHTML = page().text;  // in place of what a saved page brings along
