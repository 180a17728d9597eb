// inspect: what a scene holds, and what training would find wrong with it.
#include <algorithm>
#include <cstdio>
#include <numeric>

#include "app/json_output.h"
#include "app/scene/folder_scene.h"
#include "app/scene/inspect_report.h"
#include "app/verb.h"
#include "core/text.h"
#include "session/ray_source.h"
#include "session/settings/choices.h"
#include "session/settings/run_config.h"

namespace semfield::app {

namespace {

struct InspectOptions {
  ConfigOptions config;
  std::string frusta;
};

// What an inspection shows of training frames are the labels that would train.
void show_training_labels(LoadedScene& scene, const LabelConfig& config, Diagnostics& diagnostics) {
  read_test_labels(scene, config, diagnostics);
  TrainingLabels labels;
  try {
    labels = make_training_labels(scene, config, diagnostics);
  } catch (const Error& e) {
    if (!diagnostics.has_errors()) diagnostics.error(e.code(), "", e.message(), e.remedy());
    return;
  }
  for (const int f : scene.frames_of(Split::train)) {
    const auto i = static_cast<std::size_t>(f);
    scene.info.frames[i].has_labels = !labels.frames[i].empty();
    scene.class_pixels[i] = labels.class_pixels[i];
  }
}

// What training would say of where rays come from, or refuse at its first step.
void check_ray_source(const LoadedScene& scene, const RunConfig& config, Diagnostics& diagnostics) {
  LabelCount labels;
  labels.may_come = config.labels.selection.class_room > 0;
  for (const int f : scene.frames_of(Split::train)) {
    const Camera& camera = scene.info.frames[static_cast<std::size_t>(f)].camera;
    const std::vector<std::int64_t>& pixels = scene.class_pixels[static_cast<std::size_t>(f)];
    labels.train_px += std::int64_t{camera.width_px} * camera.height_px;
    if (!pixels.empty()) labels.labelled_px += std::accumulate(pixels.begin(), pixels.end() - 1, std::int64_t{0});
  }
  warn_of_rare_labels(config.train, labels, diagnostics);
  if (config.train.ray_source != RaySourceKind::label_balanced || labels.labelled_px > 0 || labels.may_come) return;
  const Error refused = no_labelled_pixel();
  diagnostics.error(refused.code(), "", refused.message(), refused.remedy());
}

int run(const InspectOptions& options, AppContext& context) {
  const std::string& what = options.config.config;
  const bool folder = names_a_scene(what, context);
  const FolderScene found = folder ? find_scene(what, "", context) : FolderScene();
  OpenedDataset opened = folder ? dataset_of(config_of(found, kUsualPreset), options.config.set, context)
                                : dataset_of(options.config, context);
  Diagnostics diagnostics;
  LoadedScene scene = load_for_labels(opened, diagnostics);
  if (!diagnostics.has_errors()) show_training_labels(scene, opened.config.labels, diagnostics);
  if (!diagnostics.has_errors()) check_ray_source(scene, opened.config, diagnostics);
  std::string depth;
  if (!diagnostics.has_errors()) depth = depth_use(opened.config.losses, training_depth(scene), diagnostics);
  if (context.json) {
    print_json(context, inspect_json(scene, diagnostics, depth));
  } else {
    std::fputs(inspect_report(scene, diagnostics, depth).c_str(), stdout);
  }
  if (!options.frusta.empty()) {
    write_frusta_ply(options.frusta, scene);
    print_note(context, "cameras written to " + options.frusta);
  }
  std::vector<NextStep> next = next_of_cameras(scene.cameras_are_off(), what, scene.info.name);
  const auto then = [&](std::vector<NextStep> more) {
    std::move(more.begin(), more.end(), std::back_inserter(next));
    print_next(context, next);
  };
  if (folder) {
    then(next_of_scene(what, found.name));
  } else if (!diagnostics.has_errors()) {
    const bool labels = std::any_of(scene.class_pixels.begin(), scene.class_pixels.end(),
                                    [](const std::vector<std::int64_t>& pixels) { return !pixels.empty(); });
    then(next_of_config({what, opened.config.name, labels, options.config.set, context.registry.module_files()}));
  }
  return diagnostics.has_errors() ? static_cast<int>(ErrorKind::data) : 0;
}

void words(VerbWords& verb, InspectOptions& options) {
  verb.operand("config", options.config.config, "configuration file (YAML), or the folder of a scene");
  verb.repeated("--set KEY=VALUE", options.config.set, "override a value: --set train.rays=2048");
  verb.threads(options.config.set);
  verb.value("--frusta FILE", options.frusta, "write the cameras as a PLY file");
}

}  // namespace

Verb verb_inspect() {
  return make_verb<InspectOptions>("inspect", 70, "print what a scene contains, and every problem with its remedy",
                                   words, run);
}

}  // namespace semfield::app
