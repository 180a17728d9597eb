// serve: label a scene in the browser while its field trains.
#include "app/verb.h"

#ifdef SEMFIELD_WITH_SERVE

#include <fmt/format.h>

#include <chrono>
#include <thread>

#include "app/child_process.h"
#include "app/serve/page_pictures.h"
#include "app/serve/page_server.h"
#include "app/signals.h"
#include "app/terminal.h"
#include "core/error.h"
#include "core/files.h"
#include "core/text.h"
#include "labels/serve/label_session.h"
#include "train/run_folder.h"

#endif

namespace semfield::app {

namespace {

struct ServeOptions : PageVerbOptions {
  explicit ServeOptions(const Declaration& at) : PageVerbOptions(at) {
    device(set);
    needs("--pattern", "--segments");
  }
  const std::string& what = operand("config_or_run", "configuration file, or a run folder to continue");
  const std::string& out = value("--out FOLDER", "run folder to create (default: runs/<name>)");
  const std::string& segments = value(
      "--segments PATH",
      "what a segmenter saw in the training images, whose borders labels keep to: a folder of PNGs, JSON or NumPy "
      "masks, or a COCO file");
  const std::string& pattern =
      value("--pattern NAME", "how files of that folder are named, with {name}, {stem} or {number} of the frame");
  std::vector<std::string>& set = run_settings();
};

#ifdef SEMFIELD_WITH_SERVE

class Told final : public RunListener {
 public:
  explicit Told(const AppContext& context) : context_(context) {}
  void note(const std::string& text) override { print_note(context_, text); }

 private:
  const AppContext& context_;
};

struct Target {
  RunConfig config;
  std::string run_dir;
};

// A run goes on with the configuration that it has settled.
Target going_on(const std::string& run_dir, const ServeOptions& options, Registry& registry,
                const std::string& remedy) {
  RunConfig begun = load_run_config(RunFolder::read(run_dir).config_path(), options.set, registry);
  // A run of `semfield train` has no logits for classes that are named later.
  if (begun.labels.selection.class_room == 0)
    throw Error(ErrorKind::cannot_create, "serve.run.foreign",
                run_dir + ": it holds a run that was not begun by `semfield serve`", remedy);
  return {std::move(begun), run_dir};
}

Target target_of(const ServeOptions& options, const AppContext& context, Registry& registry) {
  if (fs::is_directory(options.what)) {
    if (!options.out.empty())
      throw Error(ErrorKind::usage, "usage.flag.conflict",
                  "--out " + options.out + ": a run continues in its own folder", "leave --out out");
    return going_on(options.what, options, registry,
                    "look at it: semfield view " + shell_word(options.what) +
                        "; or label in a run of its own: semfield serve CONFIG --out FOLDER");
  }
  RunConfig config = load_run_config(options.what, options.set, registry);
  const std::string run_dir = options.out.empty() ? "runs/" + config.name : options.out;
  if (!fs::exists(fs::path(run_dir) / "run.yaml")) return {std::move(config), run_dir};
  Target target = going_on(run_dir, options, registry, "name another folder with --out");
  print_note(context, "continuing with " + run_dir + ", which is there already, by the settings in its run.yaml");
  return target;
}

// Does what signals request while the main thread trains.
class SignalWatch : NonCopyable {
 public:
  SignalWatch(LabelSession& session, PageServer& server, const AppContext& context)
      : thread_([&] {
          while (!ended_ && stop_signal() == 0) {
            std::this_thread::sleep_for(std::chrono::milliseconds(50));
            if (take_save_request()) save(session, context);
          }
          server.end_waiting();
          session.stop();
        }) {}
  ~SignalWatch() {
    ended_ = true;
    thread_.join();
  }

 private:
  static void save(LabelSession& session, const AppContext& context) {
    try {
      session.save();
      print_note(context, "saved, as SIGHUP asked");
    } catch (const Error& e) {
      print_note(context, "not saved: " + shown(e));
    }
  }
  std::atomic<bool> ended_{false};
  std::thread thread_;  // last: it reads ended_
};

int run(const ServeOptions& options, AppContext& context) {
  PageOptions page{host_at(options.address, options.port, "index", "docs/reference/labelling_http.md")};
  page.first_revision = static_cast<std::uint64_t>(now_ms());
  page.exports = {own_program(), "", context.registry.module_files()};
  Target target = target_of(options, context, context.registry);
  context.adopt(target.config);
  install_stop_signals(!context.quiet);
  install_save_signal();
  const std::string segments = (options.segments.empty() ? "" : " --segments " + shell_word(options.segments)) +
                               (options.pattern.empty() ? "" : " --pattern " + shell_word(options.pattern));
  const std::string go_on = "semfield serve " + shell_word(target.run_dir) + segments;
  stop_waits(false, "stopped before the page was there");
  Told told(context);
  LabelSession session(std::move(target.config), context.registry,
                       {.run_dir = target.run_dir, .segments = options.segments, .pattern = options.pattern}, &told);
  stop_waits(true);
  if (const int room = session.state()->room; room > kMostPageClasses)
    throw Error(ErrorKind::data, "serve.classes.limit",
                fmt::format("the scene has room for {} classes, and the page shows at most {}", room, kMostPageClasses),
                "give it a table of fewer classes: scene.classes");
  page.exports.run_dir = session.run_dir();
  page.run_id = kept_run_id(session.run_dir());  // before the token, which a copy of a run does not keep
  page.token = kept_token(session.run_dir());
  PageServer server(session, std::move(page));
  print_results(context, {{"run", session.run_dir()}, {"url", server.url()}},
                "serve: open " + server.url() + " in a browser");
  try {
    const SignalWatch watch(session, server, context);
    session.run();
  } catch (Error& error) {
    error.while_doing("stopped; every label is stored, and the run continues from its last checkpoint with `" + go_on +
                      "`");
    throw;
  }
  if (std::optional<Error> failure = session.failure()) {
    failure->while_doing(
        "training has ended; every label is stored, and the run continues from its last checkpoint with `" + go_on +
        "`");
    throw *failure;
  }
  const std::shared_ptr<const LabelState> state = session.state();
  print_note(context, fmt::format("stopped at step {} with {} labels, all saved", state->step, state->marks.size()));
  for (const ExportState& one : server.exports())
    if (one.is_open()) print_note(context, "the export " + one.id + " was stopped; begin it again on the page");
  const std::string word = shell_word(session.run_dir());
  print_next(context, {{"serve " + word + segments, "continues to label"},
                       {"train --resume " + word + " --time 5m", "trains on with these labels"}});
  return 128 + stop_signal();
}

#else

int run(const ServeOptions&, AppContext&) {
  throw Error(ErrorKind::unavailable, "serve.page.missing", "this build has no labelling page",
              "build with -DSEMFIELD_WITH_SERVE=ON, which needs the package libturbojpeg0-dev");
}

#endif

}  // namespace

Verb verb_serve() {
  return make_verb<ServeOptions>("serve", 15, "label a scene in the browser while its field trains",
                                 {"configs/my_photos.yaml", "configs/my_photos.yaml --out runs/my_clicks"}, run);
}

}  // namespace semfield::app
