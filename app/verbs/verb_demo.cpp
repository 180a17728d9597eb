// demo: the verbs that make a labelled scene, one after the other, on the shipped room.
#include <fmt/format.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <sstream>

#include "app/child_process.h"
#include "app/json_output.h"
#include "app/signals.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "config/compose.h"
#include "config/config_tree.h"
#include "core/text.h"
#include "run/run_folder.h"
#include "system/files.h"

namespace semfield::app {

namespace {

constexpr const char* kOwnFolder = "runs/demo";

struct DemoOptions : Options {
  explicit DemoOptions(const Declaration& at) : Options(at) { threads(set); }
  const std::string& out =
      value("--out FOLDER", "run folder to create (default: runs/demo, whose earlier demo is replaced)");
  std::vector<std::string>& set = settings();
  const LengthWords length = training_length();
};

// How a person starts this program: by its name where PATH leads to it.
std::string typed_program() {
  const fs::path own = own_program();
  std::error_code unknown;
  if (const std::string found = program_in_path(own.filename().string());
      !found.empty() && fs::equivalent(found, own, unknown))
    return own.filename();
  const fs::path near = own.lexically_relative(fs::current_path());
  return shell_word(near.empty() || *near.begin() == ".." ? own.string() : near.string());
}

bool is_demo(const std::string& folder) {
  const std::string file = (fs::path(folder) / "run.yaml").string();
  std::error_code unknown;
  if (!is_there(file)) return false;
  const ConfigNode tree = parse_config_file(file);
  const ConfigNode* name = tree.find("name");
  const ConfigNode* scene = tree.find("scene");
  const ConfigNode* root = scene != nullptr ? scene->find("root") : nullptr;
  return name != nullptr && name->text() == "demo" && root != nullptr &&
         fs::equivalent(root->text(), shared_file("scenes/room"), unknown);
}

// Of the folder that nobody has named, only what an earlier demo wrote is replaced.
void clear_own_folder(const AppContext& context) {
  std::error_code unknown;
  const fs::directory_iterator entries(kOwnFolder, unknown);
  // A demo that was stopped before its first step leaves the lock alone.
  if (unknown ||
      std::all_of(begin(entries), end(entries), [](const auto& e) { return e.path().filename() == ".lock"; }))
    return;
  if (!is_demo(kOwnFolder))
    throw Error(ErrorKind::cannot_create, "files.output.exists",
                fmt::format("'{}' is there already and is not an earlier demo", kOwnFolder),
                "name a new folder with --out");
  print_note(context, fmt::format("the earlier demo in {} is replaced", kOwnFolder));
  const RunFolder held = RunFolder::resume(kOwnFolder);  // refuses one that is being trained
  fs::remove_all(kOwnFolder);
}

// The figures of train's last line that say what came out.
std::string figures_of(const std::string& out) {
  std::istringstream words(out.substr(out.rfind("train: ") == std::string::npos ? 0 : out.rfind("train: ") + 7));
  std::vector<std::string> kept;
  for (std::string word; words >> word;) {
    if (!word.starts_with("steps=") && !word.starts_with("trained_s=") && !word.starts_with("peak_mb="))
      kept.push_back(word);
  }
  return join(kept, " ");
}

int run(const DemoOptions& options, AppContext& context) {
  const std::string config = shared_file("configs/quickstart.yaml");  // a file `quickstart.yaml` here is not meant
  const std::string out = options.out.empty() ? kOwnFolder : options.out;
  (void)asked_length(options.length);
  load_run_config(config, options.set, context.registry);  // refuses what is wrong before anything is replaced
  const std::string cache = cache_folder("rooms");
  print_note(context, fmt::format("a demo on the shipped room, in {}{}", fs::absolute(out).lexically_normal().string(),
                                  cache.empty() ? "" : "; cast frames are kept in " + cache));
  if (options.out.empty()) clear_own_folder(context);
  (void)RunFolder::create(out);  // refuses a folder that cannot be written before the scene is read
  // The figures are of every test frame, on a slow machine too.
  const std::string named = find_config("quickstart") == config ? "quickstart" : config;
  std::vector<std::string> train{"train", named, "--set", "report.eval_share=0", "--set", "name=demo", "--out", out};
  for (const std::string& setting : options.set) {
    // "--threads runtime.threads=2" was typed as "--threads 2".
    train.push_back("--set");
    train.push_back(setting.starts_with("--") ? setting.substr(setting.find(' ') + 1) : setting);
  }
  if (options.length.steps) train.insert(train.end(), {"--steps", std::to_string(*options.length.steps)});
  if (!options.length.time.empty()) train.insert(train.end(), {"--time", options.length.time});
  const std::string program = typed_program();
  install_stop_signals(!context.quiet);
  leave_next_out_of_children();
  std::string figures;
  for (std::vector<std::string> words :
       {train, {"render", out, "--split", "test"}, {"mesh", out, "--format", "ply,glb"}}) {
    std::string shown = program;
    for (const std::string& word : words) shown += " " + shell_word(word);
    print_note(context, "$ " + shown);
    words.insert(words.begin(), own_program());
    if (context.quiet) words.push_back("--quiet");
    if (context.json) words.push_back("--json");
    const ChildEnd end = run_child(words);
    if (!context.quiet) std::fputs(end.out.c_str(), stderr);
    if (end.code != 0) return end.code;
    if (figures.empty()) figures = context.json ? end.out : figures_of(end.out);
  }
  const std::string folder = shell_word(out);
  print_note(
      context,
      fmt::format(
          "\nThe room is labelled: {0}\n"
          "  report            {0}/report.html\n"
          "  labels, depth, …  {0}/render/test/\n"
          "  labelled mesh     {0}/mesh.ply, {0}/mesh.glb; by class: {0}/mesh_classes.ply, {0}/mesh_classes.glb\n"
          "  all figures       {1} eval {0}\n"
          "  longer training   {1} train --resume {0} --time 5m\n"
          "Your own scene: write my_scene.yaml, with `include: presets/room.yaml` and where the "
          "scene is, then\n  {1} inspect my_scene.yaml\n"
          "The guide docs/guide/own_data.md says how.",
          folder, program));
  if (context.json) {
    Json found = Json::parse(figures);  // by `train`
    found.erase("semfield");
    found.erase("verb");
    print_json(context, found);
    return 0;
  }
  std::printf("demo: %s\n", figures.c_str());
  return 0;
}

}  // namespace

Verb verb_demo() {
  return make_verb<DemoOptions>("demo", 5, "train on the shipped room, render its held-out views and write its mesh",
                                run);
}

}  // namespace semfield::app
