#include "app/scene/next_of_config.h"

#include <filesystem>

#include "core/text.h"

namespace semfield::app {

namespace {

namespace fs = std::filesystem;

// `run`, or with the first number behind it that nothing has yet.
std::string unused(const std::string& run) {
  std::error_code unknown;
  std::string free = run;
  for (int number = 2; fs::exists(free, unknown) && !fs::is_empty(free, unknown); ++number)
    free = run + "_" + std::to_string(number);
  return free;
}

}  // namespace

std::vector<NextStep> next_of_config(const KnownConfig& config) {
  std::string words = " " + shell_word(config.file);
  for (const std::string& module : config.modules) words += " --plugin " + shell_word(module);
  for (const std::string& setting : config.set) {
    // "--threads runtime.threads=2" was typed as "--threads 2".
    const bool is_short = setting.starts_with("--");
    words += " --set " + shell_word(is_short ? setting.substr(setting.find(' ') + 1) : setting);
  }
  // What suits the scene comes first and gets the folder that pages call the run.
  const auto with_folder = [&](const char* verb, const std::string& ending, const char* what) -> NextStep {
    const std::string usual = "runs/" + config.name, run = unused(usual + ending);
    return {verb + words + (run == usual ? "" : " --out " + shell_word(run)), what + run};
  };
#ifdef SEMFIELD_WITH_SERVE
  if (!config.labels)
    return {with_folder("serve", "", "label by clicks while it trains; writes "),
            with_folder("train", "_unlabelled", "trains without labels; writes ")};
  return {with_folder("train", "", "writes "),
          with_folder("serve", "_clicks", "label by clicks while it trains; writes ")};
#else
  return {with_folder("train", "", "writes ")};
#endif
}

std::vector<NextStep> next_of_cameras(bool off, const std::string& scene, const std::string& name) {
  if (!off) return {};
  return {{"prepare " + shell_word(scene) + " --out " + shell_word(unused(name + "_fixed")),
           "fixes the cameras, in a scene of its own"}};
}

std::vector<NextStep> next_of_scene(const std::string& folder, const std::string& name) {
  std::error_code unknown;
  const std::string file = "configs/" + name + ".yaml";
  if (fs::exists(file, unknown)) return {{"inspect " + shell_word(file), "the configuration that is there already"}};
  return {{"init " + shell_word(folder), "writes a configuration, and says what to do with it"}};
}

std::vector<NextStep> next_of_run(const std::string& run, bool held_out) {
  const std::string word = shell_word(run);
  std::vector<NextStep> steps;
  if (held_out) {
    steps.push_back({"eval " + word, "scores every pixel of the held-out views"});
    steps.push_back({"render " + word + " --split test", "colour, labels and depth of them"});
  }
  steps.push_back({"mesh " + word + " --format ply,html", "the surface, and a page that shows it"});
  return steps;
}

std::vector<NextStep> next_of_look([[maybe_unused]] const std::string& run) {
#ifdef SEMFIELD_WITH_SERVE
  return {{"view " + shell_word(run), "the run in the browser"}};
#else
  return {};
#endif
}

}  // namespace semfield::app
