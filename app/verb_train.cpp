// train: start, resume, or only say what would be done.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>

#include "config/compose.h"
#include "plugin/loader.h"
#include "signals.h"
#include "train/run_folder.h"
#include "train/train_run.h"
#include "verbs.h"

namespace semfield::app {

namespace {

double parse_seconds(const std::string& text) {
  std::size_t end = 0;
  double value = 0;
  try {
    value = std::stod(text, &end);
  } catch (const std::exception&) {
    end = 0;
  }
  const std::string unit = text.substr(end);
  const double factor = unit.empty() || unit == "s" ? 1 : unit == "m" ? 60 : unit == "h" ? 3600 : -1;
  if (end == 0 || factor < 0 || !(value > 0) || !std::isfinite(value)) {
    throw Error(ErrorKind::usage, "--time " + text + ": expected a positive time such as 90s, 5m or 1h");
  }
  return value * factor;
}

std::string clock_text(double seconds) {
  const auto s = static_cast<long>(std::lround(std::max(seconds, 0.0)));
  return s >= 3600 ? fmt::format("{}:{:02}:{:02}", s / 3600, s / 60 % 60, s % 60)
                   : fmt::format("{}:{:02}", s / 60, s % 60);
}

void print_progress(const AppContext& context, const TrainProgress& p) {
  if (context.quiet) return;
  const std::string line =
      fmt::format("step {}/{}  loss {:.4f}  psnr {:.2f}  miou {}  {:.0f} rays/s  {} elapsed  {} left", p.step, p.steps,
                  p.loss, p.psnr, p.miou ? fmt::format("{:.3f}", *p.miou) : "-", p.rays_per_s, clock_text(p.train_s),
                  clock_text(p.remaining_s));
  if (context.terminal) {
    std::fprintf(stderr, "\r\033[K%s%s", line.c_str(), p.step >= p.steps ? "\n" : "");
    std::fflush(stderr);
    return;
  }
  // Plain lines otherwise, about one every two seconds.
  static double next_s = 0;
  if (p.train_s < next_s && p.step < p.steps) return;
  next_s = p.train_s + 2;
  std::fprintf(stderr, "%s\n", line.c_str());
}

std::string number(const std::vector<std::pair<std::string, std::optional<double>>>& values, const std::string& name,
                   const char* format) {
  for (const auto& [key, value] : values) {
    if (key == name && value) return fmt::format(fmt::runtime(format), *value);
  }
  return "-";
}

}  // namespace

int run_train(const TrainOptions& options, AppContext& context) {
  const bool resume = !options.resume.empty();
  if (resume == !options.config.config.empty()) {
    throw Error(ErrorKind::usage, "train: expected either a configuration file or --resume RUN",
                "see `semfield train --help`");
  }
  load_modules(options.config.plugins, context);
  std::vector<std::string> settings = options.config.set;
  if (!options.time.empty())
    settings.push_back("--time train.time_limit_s=" + shortest_number(parse_seconds(options.time)));
  RunConfig config = load_run_config(resume ? RunFolder::read(options.resume).config_path() : options.config.config,
                                     settings, context.registry);
  if (options.dry_run) {
    Diagnostics diagnostics;
    SessionOptions session_options;
    session_options.keep = options.keep;
    const Session session = open_session(std::move(config), context.registry, session_options, diagnostics);
    for (const Diagnostic& finding : diagnostics.all()) print_note(context, finding.text());
    std::fputs(describe_session(session).c_str(), stdout);
    return 0;
  }
  TrainRequest request;
  request.resume = resume;
  request.keep = options.keep;
  request.out_dir = resume ? options.resume : !options.out.empty() ? options.out : "runs/" + config.name;
  TrainHooks hooks;
  hooks.progress = [&](const TrainProgress& p) { print_progress(context, p); };
  hooks.note = [&](const std::string& text) { print_note(context, text); };
  hooks.stop_signal = stop_signal;
  hooks.save_request = take_save_request;
  hooks.stop_waits = [&](bool waits) {
    stop_waits(waits, waits || context.quiet ? std::string()
                                             : fmt::format("\nstopped; every step is saved, go on with: semfield train "
                                                           "--resume {}\n",
                                                           request.out_dir));
  };
  install_stop_signals();
  install_save_signal();
  stop_waits(false, context.quiet ? "" : "\nstopped before the first step\n");
  const TrainOutcome outcome = run_training(std::move(config), context.registry, request, hooks);
  if (context.terminal && !context.quiet) std::fputs("\n", stderr);
  if (outcome.signal != 0) {
    print_note(context, fmt::format("stopped at step {} after its checkpoint; go on with: semfield train --resume {}",
                                    outcome.step, outcome.run_dir));
    return 128 + outcome.signal;
  }
  const auto& v = outcome.values;
  std::printf(
      "train: miou_present=%s total_accuracy=%s psnr=%s absrel=%s train_s=%.1f steps=%lld peak_mb=%zu report=%s\n",
      number(v, "miou_present", "{:.4f}").c_str(), number(v, "total_accuracy", "{:.4f}").c_str(),
      number(v, "psnr", "{:.2f}").c_str(), number(v, "absrel", "{:.4f}").c_str(), outcome.train_s,
      static_cast<long long>(outcome.step), outcome.peak_bytes >> 20, outcome.report_path.c_str());
  return 0;
}

void load_modules(const std::vector<std::string>& paths, AppContext& context) {
  for (const std::string& path : paths) load_module(context.registry, path);
}

void print_note(const AppContext& context, const std::string& text) {
  if (!context.quiet) std::fprintf(stderr, "%s\n", text.c_str());
}

}  // namespace semfield::app
