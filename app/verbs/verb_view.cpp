// view: look at a run in the browser, finished or still training.
#include "app/json_output.h"
#include "app/verb.h"

#ifdef SEMFIELD_WITH_SERVE

#include <fmt/format.h>

#include <chrono>
#include <exception>
#include <memory>
#include <thread>

#include "app/child_process.h"
#include "app/scene/inspect_report.h"
#include "app/signals.h"
#include "app/view/view_server.h"
#include "core/error.h"
#include "run/run_scores.h"

#endif

namespace semfield::app {

namespace {

struct ViewVerbOptions {
  std::string run, with;
  std::string address = "127.0.0.1";
  std::optional<int> port;
  std::vector<std::string> set;
};

#ifdef SEMFIELD_WITH_SERVE

int run(const ViewVerbOptions& options, AppContext& context) {
  ViewOptions view;
  view.http.address = options.address;
  view.http.port = options.port.value_or(kUsualPort);
  view.next_port = !options.port;
  (void)free_port(view.http.address, view.http.port, view.next_port);  // before anything that takes time
  install_stop_signals(!context.quiet);
  std::vector<std::unique_ptr<ViewedRun>> runs;
  for (const std::string& one : {options.run, options.with})
    if (!one.empty())
      runs.push_back(std::make_unique<ViewedRun>(run_of(one, options.set, OpenFor::rendering, context)));
  std::vector<ViewedRun*> shown;
  std::vector<std::string> names;
  for (const std::unique_ptr<ViewedRun>& one : runs) {
    shown.push_back(one.get());
    names.push_back(one->name());
  }
  view.page = live_page_text(runs.front()->name(), names);
  view.films = {own_program(), runs.front()->folder(), context.registry.module_files()};
  const ViewServer server(shown, std::move(view));
  // While the browser loads the page. What fails here fails for the page too, which says why.
  const std::jthread meshes([&shown] {
    for (ViewedRun* one : shown) {
      try {
        (void)one->scene(false);
      } catch (const std::exception&) {
        continue;
      }
    }
  });
  print_results(context, {{"run", options.run}, {"url", server.url()}}, "view: open " + server.url() + " in a browser");
  while (stop_signal() == 0) std::this_thread::sleep_for(std::chrono::milliseconds(50));
  print_next(context, next_of_run(options.run, false));
  return 128 + stop_signal();
}

#else

int run(const ViewVerbOptions&, AppContext&) {
  throw Error(ErrorKind::unavailable, "serve.page.missing", "this build has no pages that are served",
              "build with -DSEMFIELD_WITH_SERVE=ON, which needs the package libturbojpeg0-dev, or write one: semfield "
              "export RUN --to scene.html");
}

#endif

void words(VerbWords& verb, ViewVerbOptions& options) {
  verb.operand("run", options.run, "run folder");
  verb.value("--with RUN", options.with, "a second run of the same scene, side by side with the first");
  verb.value_in("--port N", options.port, 1, 65535, "port to listen on (default: 8787, or the next that is free)");
  verb.value("--address ADDRESS", options.address,
             "IPv4 address to listen on; 127.0.0.1 is this machine alone, 0.0.0.0 every network");
  verb.run_settings(options.set);
}

}  // namespace

Verb verb_view() {
  return make_verb<ViewVerbOptions>("view", 20, "look at a run in the browser, while it trains or afterwards", words,
                                    run);
}

}  // namespace semfield::app
