// Makes what the golden values are of and prints a line for each row: its name and a CRC-32C. Called with the parts
// that it is to make:
// steps  parameters, moments and states after 20 steps of every golden configuration on the CPU
// cuda   the same on an NVIDIA GPU in deterministic mode; ends with 69 where there is none
// files  of a run of 200 steps on the CPU what every verb writes, of a labelling session the clicks, the checkpoint
//        and the pictures of the page, and run.yaml of every preset; times and facts of the machine are left out
#include <fnmatch.h>

#include <cstdio>
#include <regex>

#include "core/checksum.h"
#include "labels/clicks.h"
#include "labels/serve/label_session.h"
#include "scene/loading/packed_scene.h"
#include "tests/analytic_scene.h"
#include "tests/program.h"
#include "tests/session/train_testing.h"
#include "train/run_folder.h"
#ifdef SEMFIELD_PAGE
#include "app/serve/page_pictures.h"
#endif

namespace semfield {
namespace {

using namespace testing_train;

constexpr std::int64_t kSteps = 20, kSaved = 10;

const std::string kHash = "{type: hash_grid, levels: 4, log2_entries: 10, finest_resolution: 64}";
const std::string kFrequency = "{type: frequency, frequencies: 4}";
const std::string kHarmonics = "{type: spherical_harmonics, degree: 3}";
const std::string kTiny = "{type: tiny_mlp, hidden_width: 32, color_width: 24}";
const std::string kDeep = "{type: nerf_mlp, depth: 4, width: 32, skip_at: 2, view_width: 16}";
// Updated in steps 4, 8, ..., from step 8 on a part of the cells at a time.
const std::string kGrid = "{type: occupancy_grid, resolution: 32, update_every: 4, warmup_steps: 8, max_samples: 48}";
const std::string kEven = "{type: stratified, samples: 12}";
const std::string kWeighted = "{type: importance, samples: 12}";
const std::string kBranch =
    "    semantic: {position: {type: one_blob, bins: 8}, field: {type: tiny_mlp, hidden_width: 16, hidden_layers: 2}, "
    "dropout: 0.2}\n";

struct Golden {
  std::string name, yaml;
  bool resumed = false;
};

std::string pass(const std::string& name, const std::string& sampler, const std::string& position,
                 const std::string& direction, const std::string& field) {
  return "  - name: " + name + "\n    sampler: " + sampler + "\n    position: " + position +
         "\n    direction: " + direction + "\n    field: " + field + "\n";
}

// Lanes and tiles order the sums: fixed here, so that a better choice of the defaults changes no golden value.
std::string tile_rays(const std::string& passes) {
  if (passes.find("occupancy_grid") != std::string::npos) return "32";
  return passes.find("importance") != std::string::npos ? "42" : "64";
}

/// `scene` is what stands beside its type, `more` follows the passes.
Golden golden(const std::string& name, const std::string& passes, const std::string& more = "",
              const std::string& scene = "", const std::string& train = "") {
  const bool bf16 = name.ends_with("bf16");
  return {name, "scene: {type: analytic_room" + scene +
                    "}\nsemantics: {hidden_width: 16, weight: 0.1}\n"
                    "rendering: {density_activation: softplus, far: background, unit_m: 1}\npasses:\n" +
                    passes + more + "train: {steps: 20, rays: 128, adam: {learning_rate: 0.01}" + train +
                    "}\nruntime: {device: cpu, lanes: 8, tile_rays: " + tile_rays(passes) +
                    ", precision: " + (bf16 ? "bf16" : "fp32") + "}\n"};
}

std::vector<Golden> goldens() {
  const std::string hash = pass("main", kGrid, kHash, kHarmonics, kTiny);
  const std::string paper = pass("coarse", kEven, kFrequency, "{type: frequency, frequencies: 2}", kDeep) +
                            pass("fine", kWeighted, kFrequency, "{type: frequency, frequencies: 2}", kDeep);
  std::vector<Golden> all{
      golden("tiny_hash_grid_occupancy", hash),
      golden("tiny_hash_grid_occupancy_bf16", hash),
      golden("nerf_frequency_importance", paper),
      golden("nerf_frequency_importance_bf16", paper),
      golden("nerf_hash_grid_occupancy", pass("main", kGrid, kHash, "{type: frequency, frequencies: 2}", kDeep)),
      golden("tiny_frequency_occupancy_bf16", pass("main", kGrid, kFrequency, kHarmonics, kTiny)),
      golden("tiny_one_blob_importance", pass("coarse", kEven, "{type: one_blob}", kHarmonics, kTiny) +
                                             pass("fine", kWeighted, "{type: one_blob}", kHarmonics, kTiny)),
      golden("nerf_identity_stratified", pass("main", kEven, "{type: identity}", "{type: identity}", kDeep)),
      golden("sparse_labels", hash, "", ", labels: {frames: 2}", ", ray_source: label_balanced"),
      golden("soft_labels", hash, "", ", labels: {degrade: [{type: simulated_predictions}]}"),
      golden("semantic_branch", hash, kBranch),
  };
  all.push_back(all.front());
  all.back().name = "resumed_at_step_10";
  all.back().resumed = true;
  return all;
}

// `text` with every match of `pattern` replaced.
std::string replaced(const std::string& text, const std::string& pattern, const std::string& by) {
  return std::regex_replace(text, std::regex(pattern), by);
}

void print(const std::string& name, std::uint32_t value) {
  std::printf("%s %08x\n", name.c_str(), value);
  std::fflush(stdout);
}

std::uint32_t crc(std::string_view text, std::uint32_t before = 0) {
  return crc32c(std::as_bytes(std::span(text)), before);
}

struct Run {
  explicit Run(const std::string& yaml, Registry& registry) : session(open_text(yaml, registry)) {}
  Session session;
  Trainer trainer{session};
  std::uint32_t to(std::int64_t step) {
    while (trainer.step() < step) trainer.advance();
    trainer.collect();
    return fingerprint(session.pipeline->store());
  }
};

// The checkpoint of a run, whose file has nothing but tensors and one fact.
std::string saved(Run& run, CheckpointStore& store, std::int64_t step) {
  run.to(step);
  return store.save(step, run.trainer.tensors(), {{"train_s", "1"}});
}

std::uint32_t trained(const Golden& golden, Registry& registry) {
  Run run(golden.yaml, registry);
  if (!golden.resumed) return run.to(kSteps);
  const TempDir dir;
  CheckpointStore store(dir.path());
  saved(run, store, kSaved);
  Run resumed(golden.yaml, registry);
  Diagnostics diagnostics;
  auto found = store.find_latest(diagnostics);
  if (!found) throw Error(ErrorKind::failure, "test.error.made", "the checkpoint of step 10 is not found");
  resumed.trainer.load(found->file, found->step);
  return resumed.to(kSteps);
}

void print_steps(Registry& registry, bool cuda) {
  for (Golden golden : goldens()) {
    if (cuda) golden.yaml = replaced(golden.yaml, "device: cpu", "device: cuda, deterministic: true");
    print((cuda ? "cuda/" : "steps/") + golden.name, trained(golden, registry));
  }
  if (cuda) {  // the bits are those of a compute capability
    const Session session = open_text(replaced(goldens().front().yaml, "device: cpu", "device: cuda"), registry);
    std::printf("device %s\n",
                replaced(session.pipeline->executor().description(), ".*capability ", "compute_").c_str());
  }
}

// Files that `words` of the program leave, after those of the rows above: a pattern per row.
struct Made {
  const char *row, *words, *files;
};
constexpr const char* kObjects = "objects run --score --set objects.steps=100 --set objects.points=2000";
constexpr Made kMade[] = {
    {"packed_scene", "", "room.sfpack"},
    {"run_yaml", "", "run/run.yaml"},
    {"run_rows", "", "run/metrics.jsonl"},
    {"run_scores", "", "run/final_eval.json"},
    {"run_worst_frames", "", "run/worst_frames.json"},
    {"run_labels", "", "run/labels.json"},
    {"run_left_out", "", "run/left_out.json"},
    {"run_classes", "", "run/classes.yaml"},
    {"eval", "", "eval.json"},
    {"render_color", "render run --npy --probability --out render", "render/*_rgb.png"},
    {"render_label", "", "render/*_label.png"},
    {"render_depth", "", "render/*_depth.[np]*"},
    {"render_entropy", "", "render/*_entropy.[np]*"},
    {"render_probability", "", "render/*_probability.npy"},
    {"render_for_the_eye", "", "render/*_vis.png"},
    {"render_cameras", "", "render/*.json"},
    {"mesh_ply", "mesh run --resolution 32 --format ply,obj,glb --points --out mesh.ply", "mesh*.ply"},
    {"mesh_obj", "", "mesh*.[om][bt]*"},
    {"mesh_glb", "", "mesh*.glb"},
    {"mesh_sidecar", "", "mesh.json"},
    {"mesh_density", "mesh run --resolution 24 --surface density --faces 900 --out dense.ply", "dense*.ply"},
    {"points", "mesh run --resolution 24 --format las,pcd,npz,bt,ot,pgm --out over", "over.[lp][ac]*"},
    {"voxels_and_maps", "", "over.[nbopy][pbtga]*"},
    {"objects_table", kObjects, "run/objects/objects.[cj]s*"},
    {"objects_surface", "", "run/objects/objects.ply"},
    {"objects_images", "", "run/objects/*/*.png"},
    {"export_coco", "labels export run --out coco.json", "coco.json"},
    {"export_coco_rle", "labels export run --format coco_rle --out rle.json", "rle.json"},
    {"export_labelme", "labels export run --format labelme --out labelme", "labelme/*"},
    {"export_png", "labels export run --format png --out png", "png/*"},
    {"propagated", "labels propagate run --out spread", "spread/*"},
    {"voted", "labels propagate run --method vote --out vote", "vote/*"},
    {"fused", "labels fuse config.yaml --depth-from run --out fused", "fused/*"},
    {"degraded", "labels degrade config.yaml --out degraded", "degraded/*"},
    {"report", "report run --no-3d", "run/report.html"},
};

// What the page shows.
std::string report_data(const std::string& html) {
  const std::size_t begin = html.find("id=\"data\">");
  return html.substr(begin, html.find("</script>", begin) - begin);
}

// Without what another folder, hour, version or measurement of docs/reference/leave_out.json gives.
std::string lasting(const std::string& path, const std::string& folder) {
  const std::string text = read_text_file(path), ending = fs::path(path).extension();
  if (ending != ".json" && ending != ".yaml" && ending != ".jsonl" && ending != ".html") return text;
  std::string here = replaced(text, R"re("[^"]{0,99}; of docs/reference/leave_out.md)re", "\"");
  for (std::size_t at = here.find(folder); at != std::string::npos; at = here.find(folder))
    here.replace(at, folder.size(), "DIR");
  if (ending == ".html") return report_data(here);
  return replaced(here, R"re("(semfield|train_s|seconds)": ?(\{[^}]*\}|[^,}\n]*))re", "");
}

void print_files_of(const Made& made, const std::string& folder) {
  std::vector<std::string> names;
  for (const auto& entry : fs::recursive_directory_iterator(folder))
    if (entry.is_regular_file()) names.push_back(fs::relative(entry.path(), folder).string());
  std::erase_if(names, [&](const std::string& name) { return fnmatch(made.files, name.c_str(), 0) != 0; });
  if (names.empty()) throw Error(ErrorKind::failure, "test.error.made", std::string("no file ") + made.files);
  std::sort(names.begin(), names.end());
  std::uint32_t sum = 0;
  for (const std::string& name : names) sum = crc(lasting(folder + "/" + name, folder), crc(name, sum));
  print(std::string("files/") + made.row, sum);
}

void write_scene(const std::string& path) {
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene();
  Diagnostics diagnostics;
  SceneInfo info = scene->open(diagnostics);
  for (FrameInfo& frame : info.frames) frame.has_instances = true;
  write_packed_scene(path, info, [&](int frame, FrameBuffer& buffer) {
    scene->read(frame, buffer);
    for (const std::int16_t label : buffer.label) buffer.instance.push_back(static_cast<std::uint16_t>(label + 1));
  });
}

void run_program(const std::string& words, const TempDir& dir) {
  const testing_program::Result done = testing_program::semfield_run(words, dir.path());
  if (done.code != 0) throw Error(ErrorKind::failure, "test.error.made", "semfield " + words + ": " + done.err);
}

void print_run(const TempDir& dir) {
  write_scene(dir / "room.sfpack");
  std::string yaml = golden("run", pass("main", kGrid, kHash, kHarmonics, kTiny),
                            "losses: [{type: depth, weight: 0.3}]\n"
                            "report: {eval_every_s: 0, strips: 1, log_every_steps: 5, checkpoint_every_s: 0}\n",
                            ", labels: {frames: 5, degrade: [{type: pixel_noise}]}")
                         .yaml;
  yaml = replaced(replaced(yaml, "analytic_room", "packed, file: room.sfpack"), "steps: 20,", "steps: 200,");
  dir.write("config.yaml", yaml);
  run_program("train config.yaml --out run --no-3d", dir);
  run_program("eval run --protocol semantic_nerf --out eval.json", dir);
  print("files/run_checkpoint", checkpoint_fingerprint(dir / "run", 200));
  // From here on a step takes a second, and the machine is none.
  for (const char* file : {"run/metrics.jsonl", "run/final_eval.json"}) {
    const std::string text =
        replaced(read_text_file(dir / file), R"re(("step":)(\d+),"train_s":[^,}]*)re", "$1$2,\"train_s\":$2");
    dir.write(file, replaced(text, R"re("rays_per_s":[^,}]*)re", "\"rays_per_s\":128"));
  }
  dir.write("run/environment.json", "{\"seed\": 1}");
  for (const Made& made : kMade) {
    if (*made.words != '\0') run_program(made.words, dir);
    print_files_of(made, dir.path());
  }
}

// What opening a scene settles of each preset; the precision is the machine's.
void print_presets(Registry& registry, const TempDir& dir) {
  const std::string configs = SEMFIELD_SOURCE_DIR "/configs";
  for (const std::string& folder : {configs, configs + "/presets"}) {
    for (const auto& entry : fs::directory_iterator(folder)) {
      const std::string name = entry.path().stem();
      if (!entry.is_regular_file()) continue;
      const std::string config =
          dir.write(name + ".yaml", "include: \"" + entry.path().string() +
                                        "\"\nscene: {type: packed, file: room.sfpack, labels: {frames: 50%}}\n"
                                        "runtime: {device: cpu}\n");
      (void)semfield::Run(load_run_config(config, {}, registry), registry, TrainRequest{.out_dir = dir / name},
                          nullptr);
      print("preset/" + name, crc(replaced(lasting(dir / name + "/run.yaml", dir.path()), "\n  precision:.*", "")));
    }
  }
}

LabelEvent event(const std::string& id, LabelEventKind kind, const std::string& name) {
  return LabelEvent{.id = id, .kind = kind, .unix_ms = 1'700'000'000'000, .class_name = name};
}

LabelEvent click(const std::string& id, const FrameInfo& frame, const std::string& name,
                 std::vector<PixelPoint> points) {
  LabelEvent made = event(id, LabelEventKind::click, name);
  made.frame = frame.name;
  made.width_px = frame.camera.width_px;
  made.height_px = frame.camera.height_px;
  made.fill = points.size() == 4;
  made.radius_px = made.fill ? 0 : 1.5;
  made.points = std::move(points);
  return made;
}

// No time passes here: surfaces and clicks are finished before training goes on for a number of steps.
void print_labelling(Registry& registry, const TempDir& dir) {
  const std::string yaml = replaced(golden("labelled", pass("main", kGrid, kHash, kHarmonics, kTiny),
                                           kBranch + "losses: [{type: depth, weight: 0.3}]\n",
                                           ", with_labels: false, with_classes: false, labels: {class_room: 4}")
                                        .yaml,
                                    "steps: 20,", "steps: 60,");
  TrainRequest labelled{.out_dir = dir / "labelled"};
  labelled.driver = Driver::page;
  LabelSession run({std::make_unique<semfield::Run>(run_config_of(parse_config_text(yaml, "test.yaml"), registry),
                                                    registry, labelled, nullptr),
                    {}});
  const auto train_to = [&](std::int64_t step) { run.train(1e9, [&] { return run.step() >= step; }); };
  train_to(60);
  while (!run.loop().ready()) run.tend(false, false, false);
  run.take_events();
  const SceneInfo& scene = run.opened().scene.info;
  const auto frame = [&](int view) -> const FrameInfo& {
    return scene.frames[static_cast<std::size_t>(run.loop().views()[static_cast<std::size_t>(view)].frame)];
  };
  for (const char* name : {"wall", "floor", "box"}) run.apply(event(name, LabelEventKind::add_class, name));
  run.apply(click("a", frame(0), "wall", {{24.5, 5.5}}));
  run.apply(click("b", frame(0), "floor", {{20.5, 33.5}, {30.5, 34}}));
  run.apply(click("c", frame(3), "box", {{10, 10}, {20, 10}, {20, 22}, {10, 22}}));
  run.apply(click("d", frame(4), "floor", {{2.5, 2.5}}));
  LabelEvent undo = event("e", LabelEventKind::undo, "");
  undo.of = "d";
  run.apply(undo);
  print("session/click_file", crc(read_text_file(dir / "labelled/clicks.jsonl")));
  run.take_events();
  while (!run.knows_all()) run.tend(false, false, false);
  run.tend(false, true, false);  // a pause, in which what was learned quickly is learned well
  train_to(100);
  run.keep(true);
  print("session/checkpoint", checkpoint_fingerprint(dir / "labelled", 100));
#ifdef SEMFIELD_PAGE
  const std::vector<ClassState> classes{{0, 1, "wall", {200, 30, 30}}, {1, 2, "floor", {30, 200, 30}}};
  for (const bool color : {false, true}) {
    Picture picture =
        run.pictures().make({.client = "golden", .view = 3, .color = color, .entropy = true, .full = color});
    picture.render_ms = 0;
    print(color ? "session/page_picture" : "session/page_labels", crc(app::picture_bytes(picture, classes)));
  }
#else
  std::printf("session/page_picture -\nsession/page_labels -\n");
#endif
}

void print_files(Registry& registry) {
  const TempDir dir;
  fs::current_path(dir.path());
  CheckpointStore store(dir / "store");
  Run run(goldens().front().yaml, registry);
  print("files/checkpoint_file", crc(read_text_file(saved(run, store, 1))));
  print_run(dir);
  print_presets(registry, dir);
  print_labelling(registry, dir);
}

}  // namespace
}  // namespace semfield

int main(int argc, char** argv) {
  try {
    semfield::Registry registry = semfield::testing_train::make_registry();
    for (int i = 1; i < argc; ++i) {
      const std::string part = argv[i];
      if (part == "files") semfield::print_files(registry);
      if (part != "files") semfield::print_steps(registry, part == "cuda");
    }
    return 0;
  } catch (const semfield::Error& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return static_cast<int>(error.kind());
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
  }
}
