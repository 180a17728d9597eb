#include "command_line.h"

#include <CLI/CLI.hpp>
#include <cmath>

#include "bench_step.h"
#include "plugin/loader.h"

namespace semfield::app {

namespace {

// `choice` is the verb's function, bound when the words were parsed.
using Choice = std::function<int()>;

// A flag that is a short form of `--set KEY=...`: added behind `--set`, whose values it follows.
void setting_option(CLI::App* verb, std::vector<std::string>& set, const std::string& flag, const std::string& key,
                    const std::string& help) {
  verb->add_option_function<std::string>(
      flag, [&set, flag, key](const std::string& value) { set.push_back(flag + " " + key + "=" + value); }, help);
}

void threads_option(CLI::App* verb, std::vector<std::string>& set) {
  setting_option(verb, set, "--threads", "runtime.threads", "CPU threads (results do not depend on it)");
}

void config_options(CLI::App* verb, ConfigOptions& options) {
  verb->add_option("config", options.config, "configuration file (YAML)")->required();
  verb->add_option("--set", options.set, "override a value: --set train.rays=2048")->expected(1)->take_all();
}

void run_options(CLI::App* verb, std::vector<std::string>& set) {
  verb->add_option("--set", set, "override a value of run.yaml")->expected(1)->take_all();
  threads_option(verb, set);
}

// CLI::PositiveNumber takes "nan".
CLI::Validator positive_number() {
  return {[](const std::string& text) {
            double value = 0;
            const bool read = CLI::detail::lexical_cast(text, value);
            return read && value > 0 && std::isfinite(value) ? std::string()
                                                             : "expected a positive number, got '" + text + "'";
          },
          "POSITIVE"};
}

void add_train(CLI::App& root, AppContext& context, Choice& choice) {
  auto options = std::make_shared<TrainOptions>();
  CLI::App* verb = root.add_subcommand("train", "train a field on a scene; writes a run folder");
  verb->add_option("config", options->config.config, "configuration file (YAML)");
  verb->add_option("--set", options->config.set, "override a value: --set train.rays=2048")->expected(1)->take_all();
  verb->add_option("--out", options->out, "run folder to create (default: runs/<name>)");
  verb->add_option("--resume", options->resume, "run folder to resume");
  verb->add_option("--time", options->time, "end after this much training: 90s, 5m, 1h");
  std::vector<std::string>& set = options->config.set;
  setting_option(verb, set, "--steps", "train.steps", "end after this many steps");
  threads_option(verb, set);
  setting_option(verb, set, "--memory", "runtime.memory_gb",
                 "GB that the run may use; a run that needs more is refused (default: what is free)");
  setting_option(verb, set, "--device", "runtime.device", "auto, cpu or cuda");
  verb->add_option("--keep", options->keep, "keep a component that would be left out")->expected(1)->take_all();
  verb->add_flag("--dry-run", options->dry_run, "print what would be built, left out and needed, then stop");
  verb->callback(
      [&context, &choice, options] { choice = [&context, options] { return run_train(*options, context); }; });
}

void add_run_verbs(CLI::App& root, AppContext& context, Choice& choice) {
  auto eval = std::make_shared<EvalOptions>();
  CLI::App* verb = root.add_subcommand("eval", "evaluate a run's field on a split");
  verb->add_option("run", eval->run, "run folder")->required();
  verb->add_option("--split", eval->split, "train or test");
  verb->add_option("--out", eval->out, "also write the JSON object to this file");
  run_options(verb, eval->set);
  verb->callback([&context, &choice, eval] { choice = [&context, eval] { return run_eval(*eval, context); }; });

  auto render = std::make_shared<RenderOptions>();
  verb = root.add_subcommand("render", "render colour, label, depth and entropy images from a run's field");
  verb->add_option("run", render->run, "run folder")->required();
  verb->add_option("--split", render->split, "train or test");
  verb->add_option(
      "--trajectory", render->trajectory,
      "file with one camera-to-world matrix per line (12 or 16 numbers), or 'smooth' for a path through the "
      "training cameras, instead of a split");
  verb->add_option("--frames", render->frames, "number of frames of the smooth path (default: 240)");
  verb->add_option("--out", render->out,
                   "folder for the images, or the video's file (default: render/ in the run folder)");
  CLI::Option* video = verb->add_flag("--video", render->video, "write a video through ffmpeg instead of images");
  verb->add_option("--panels", render->panels, "panels side by side: rgb,label,depth,entropy (default: all)")
      ->needs(video);
  verb->add_option("--fps", render->fps, "frames per second of the video (default: 24)");
  verb->add_flag("--npy", render->npy, "also write depth and entropy as float32 .npy");
  run_options(verb, render->set);
  verb->callback([&context, &choice, render] { choice = [&context, render] { return run_render(*render, context); }; });

  auto runs = std::make_shared<std::vector<std::string>>();
  auto out = std::make_shared<std::string>();
  verb = root.add_subcommand("report", "write one HTML page about one or several runs");
  verb->add_option("runs", *runs, "run folders")->required();
  verb->add_option("--out", *out, "file to write (default: report.html of the first run)");
  verb->callback(
      [&context, &choice, runs, out] { choice = [&context, runs, out] { return run_report(*runs, *out, context); }; });
}

void add_sweep(CLI::App& root, AppContext& context, Choice& choice) {
  auto options = std::make_shared<SweepOptions>();
  CLI::App* verb = root.add_subcommand("sweep", "run experiments: a grid of differences, scenes and seeds");
  verb->add_option("file", options->file, "sweep file (YAML)")->required();
  verb->add_option("--out", options->out,
                   "folder of cells and tables (default: runs/<name>); an existing one is resumed");
  verb->add_option("--jobs", options->jobs, "cells at a time (default: every core)")->check(CLI::Range(1, 4096));
  verb->add_option("--threads", options->threads, "threads of each cell (default: 1)")->check(CLI::Range(1, 4096));
  verb->add_option("--memory", options->memory_gb, "GB that all cells together may use (default: 80 % of what is free)")
      ->check(positive_number());
  verb->add_flag("--keep-checkpoints", options->keep_checkpoints, "keep the checkpoints of finished cells");
  verb->add_flag("--dry-run", options->dry_run, "list the cells, then stop");
  verb->callback(
      [&context, &choice, options] { choice = [&context, options] { return run_sweep(*options, context); }; });
}

void add_mesh(CLI::App& root, AppContext& context, Choice& choice) {
  auto options = std::make_shared<MeshOptions>();
  CLI::App* verb = root.add_subcommand("mesh", "write the field's surface with colour and class, as PLY, OBJ or GLB");
  verb->add_option("run", options->run, "run folder")->required();
  CLI::Option* resolution =
      verb->add_option("--resolution", options->resolution, "cells along the longest side of the scene (default: 256)");
  verb->add_option("--voxel", options->voxel, "edge of a cell in metres, instead of --resolution")
      ->excludes(resolution);
  verb->add_option("--level", options->level,
                   "density of the surface in 1/m (default: the one that agrees best with rendered depth)");
  verb->add_option("--format", options->formats, "ply, obj, glb; several with commas")->delimiter(',');
  verb->add_flag("--points", options->points, "also write a labelled point cloud from the depth of the training views");
  verb->add_option("--out", options->out, "file to write (default: mesh.ply in the run folder)");
  verb->add_option("--keep-components", options->keep_components,
                   "keep connected parts with at least this share of all faces (default: 0.002; 0 keeps all)");
  run_options(verb, options->set);
  verb->callback(
      [&context, &choice, options] { choice = [&context, options] { return run_mesh(*options, context); }; });
}

void add_scene_verbs(CLI::App& root, AppContext& context, Choice& choice) {
  auto options = std::make_shared<ConfigOptions>();
  auto path = std::make_shared<std::string>();
  CLI::App* verb = root.add_subcommand("inspect", "print what a scene contains, and every problem with its remedy");
  config_options(verb, *options);
  threads_option(verb, options->set);
  verb->add_option("--frusta", *path, "write the cameras as a PLY file");
  verb->callback([&context, &choice, options, path] {
    choice = [&context, options, path] { return run_inspect(*options, *path, context); };
  });

  verb = root.add_subcommand("capture", "write a scene's frames in Replica layout");
  config_options(verb, *options);
  threads_option(verb, options->set);
  verb->add_option("--out", *path, "folder to create")->required();
  verb->callback([&context, &choice, options, path] {
    choice = [&context, options, path] { return run_capture(*options, *path, context); };
  });

  verb = root.add_subcommand("pack", "write a scene as one file, for machines without image libraries");
  config_options(verb, *options);
  threads_option(verb, options->set);
  verb->add_option("--out", *path, "file to write (.sfpack)")->required();
  verb->callback([&context, &choice, options, path] {
    choice = [&context, options, path] { return run_pack(*options, *path, context); };
  });
}

void add_degrade(CLI::App& root, AppContext& context, Choice& choice) {
  auto options = std::make_shared<ConfigOptions>();
  auto folder = std::make_shared<std::string>();
  CLI::App* verb = root.add_subcommand("degrade", "write the training labels, degraded as the configuration says");
  config_options(verb, *options);
  threads_option(verb, options->set);
  verb->add_option("--out", *folder, "folder to create")->required();
  verb->callback([&context, &choice, options, folder] {
    choice = [&context, options, folder] { return run_degrade(*options, *folder, context); };
  });
}

void add_fuse(CLI::App& root, AppContext& context, Choice& choice) {
  auto options = std::make_shared<FuseOptions>();
  CLI::App* verb = root.add_subcommand("fuse", "combine predictions of several views by depth, and score them");
  config_options(verb, options->config);
  threads_option(verb, options->config.set);
  verb->add_option("--method", options->method, "monocular, bayesian, average, with commas (default: fuse.methods)");
  verb->add_option("--depth", options->depth, "true or learned (default: fuse.depth)");
  verb->add_option("--depth-from", options->depth_from,
                   "run folder whose field gives depth, and another row of labels");
  verb->add_option("--out", options->out, "folder for the fused maps and fuse.json");
  verb->callback(
      [&context, &choice, options] { choice = [&context, options] { return run_fuse(*options, context); }; });
}

void add_propagate(CLI::App& root, AppContext& context, Choice& choice) {
  auto to = std::make_shared<PropagateOptions>();
  CLI::App* verb = root.add_subcommand("propagate", "spread training labels over the surface that a run has learned");
  verb->add_option("run", to->run, "run folder")->required();
  verb->add_option("--out", to->out, "folder to create")->required();
  run_options(verb, to->set);
  setting_option(verb, to->set, "--method", "propagate.method", "surface (diffusion) or vote (pooling)");
  verb->callback([&context, &choice, to] { choice = [&context, to] { return run_propagate(*to, context); }; });
}

void add_label_verbs(CLI::App& root, AppContext& context, Choice& choice) {
  auto out = std::make_shared<ExportOptions>();
  CLI::App* verb = root.add_subcommand("export", "write the labels of a run's field for labelling tools");
  verb->add_option("run", out->run, "run folder")->required();
  verb->add_option("--split", out->split, "train or test");
  verb->add_option("--format", out->format, "coco (polygons), coco_rle (run lengths) or labelme");
  verb->add_option("--min-area", out->min_area,
                   "merge regions of fewer pixels into the class around them (default: merge none)");
  verb->add_option("--out", out->out, "file to write for COCO, folder for labelme")->required();
  run_options(verb, out->set);
  verb->callback([&context, &choice, out] { choice = [&context, out] { return run_export(*out, context); }; });

  auto classes = std::make_shared<ClassesOptions>();
  verb = root.add_subcommand("classes", "convert class tables from and to the formats of other tools");
  verb->add_option("in", classes->in,
                   "table (.yaml, .csv, .json, CVAT's .txt, ScanNet's .tsv), or nyu13, nyu40, scannet20")
      ->required();
  verb->add_option("--format", classes->format, "yaml, csv or cvat");
  verb->add_option("--ids", classes->ids, "ids to take from ScanNet's .tsv: raw, nyu40 or nyu13");
  verb->add_option("--colors", classes->colors, "keep, pascal (VOC's bit pattern) or semfield");
  verb->add_option("--out", classes->out, "file to write (default: stdout)");
  verb->callback([&choice, classes] { choice = [classes] { return run_classes(*classes); }; });
}

void add_config_verbs(CLI::App& root, AppContext& context, Choice& choice) {
  CLI::App* group = root.add_subcommand("config", "check, explain and compare configurations");
  group->require_subcommand(1);
  auto options = std::make_shared<ConfigOptions>();
  CLI::App* verb = group->add_subcommand("check", "read a configuration and report every error");
  config_options(verb, *options);
  verb->callback(
      [&context, &choice, options] { choice = [&context, options] { return run_config_check(*options, context); }; });
  verb = group->add_subcommand("explain", "print the final tree, with the origin of every value");
  config_options(verb, *options);
  verb->callback(
      [&context, &choice, options] { choice = [&context, options] { return run_config_explain(*options, context); }; });
  auto pair = std::make_shared<std::pair<std::string, std::string>>();
  verb = group->add_subcommand("diff", "print what differs between two configurations");
  verb->add_option("a", pair->first, "configuration file (YAML), such as a run.yaml")->required();
  verb->add_option("b", pair->second, "the other one")->required();
  verb->callback([&context, &choice, pair] {
    choice = [&context, pair] { return run_config_diff(pair->first, pair->second, context); };
  });
  verb = group->add_subcommand("schema", "print a JSON schema of configurations (and --plugin modules)");
  auto of_sweeps = std::make_shared<bool>(false);
  verb->add_flag("--sweep", *of_sweeps, "print the schema of sweep files instead");
  verb->callback([&context, &choice, of_sweeps] {
    choice = [&context, of_sweeps] { return run_config_schema(*of_sweeps, context); };
  });
}

void add_runs_verbs(CLI::App& root, AppContext& context, Choice& choice) {
  CLI::App* group = root.add_subcommand("runs", "compare finished runs");
  group->require_subcommand(1);
  auto pair = std::make_shared<std::pair<std::string, std::string>>();
  CLI::App* verb = group->add_subcommand(
      "equal", "check whether two runs are the same training, bit by bit; times, threads and places do not count");
  verb->add_option("a", pair->first, "run folder")->required();
  verb->add_option("b", pair->second, "run folder")->required();
  verb->callback([&context, &choice, pair] {
    choice = [&context, pair] { return run_runs_equal(pair->first, pair->second, context); };
  });
}

void add_plugins_verbs(CLI::App& root, AppContext& context, Choice& choice) {
  CLI::App* group = root.add_subcommand("plugins", "list plugins and their parameters");
  group->require_subcommand(1);
  const auto bind = [&choice](CLI::App* verb, std::function<int()> run) {
    verb->callback([&choice, run] { choice = run; });
  };
  bind(group->add_subcommand("list", "list every plugin with one sentence"),
       [&context] { return run_plugins_list(context); });
  auto name = std::make_shared<std::string>();
  CLI::App* show = group->add_subcommand("show", "print the parameters of one plugin");
  show->add_option("name", *name, "name of the plugin")->required();
  bind(show, [&context, name] { return run_plugins_show(*name, context); });
  auto out = std::make_shared<std::string>();
  CLI::App* docs = group->add_subcommand("docs", "write the reference page");
  docs->add_option("--out", *out, "file to write, or a source tree whose pages are renewed (default: stdout)");
  bind(docs, [&context, out] { return run_plugins_docs(*out, context); });
  bind(group->add_subcommand("matrix", "print which plugin runs on which device"),
       [&context] { return run_plugins_matrix(context); });
}

void add_bench_quadrature(CLI::App& group, AppContext& context, Choice& choice) {
  auto options = std::make_shared<BenchQuadratureOptions>();
  CLI::App* verb = group.add_subcommand(
      "quadrature", "measure the error of every sampler rule of the rendering integral, against evaluations and time");
  verb->add_option("--rays", options->rays, "number of rays for jittered rules and media with jumps (default: 1024)")
      ->check(CLI::Range(16, 1000000));
  verb->add_option("--out", options->out, "folder for plots (SVG), tables.md and quadrature.json");
  verb->callback([&context, &choice, options] {
    choice = [&context, options] { return run_bench_quadrature(*options, context); };
  });
}

void add_bench_gpu(CLI::App& group, AppContext& context, Choice& choice) {
  auto options = std::make_shared<BenchGpuOptions>();
  CLI::App* verb = group.add_subcommand("gpu", "time training steps and frames on a GPU");
  verb->add_flag("--peers", options->peers, "alternate with the same steps in PyTorch and print ratios");
  verb->add_option("--only", options->only, "measurements whose names begin with this: --only 'paper bf16'");
  verb->add_option("--repeats", options->repeats, "rounds; figures are medians of them")->check(CLI::Range(1, 1000));
  verb->add_option("--python", options->python, "interpreter with torch (default: python3)");
  verb->callback(
      [&context, &choice, options] { choice = [&context, options] { return run_bench_gpu(*options, context); }; });
}

void add_bench_verbs(CLI::App& root, AppContext& context, Choice& choice) {
  CLI::App* group = root.add_subcommand("bench", "measure speed, integration error and left-out components");
  group->require_subcommand(1);
  add_bench_quadrature(*group, context, choice);
  add_bench_gpu(*group, context, choice);
  auto options = std::make_shared<BenchStepOptions>();
  CLI::App* step = group->add_subcommand("step", "time whole training steps, beside the machine's limits");
  step->add_flag("--peers", options->peers, "alternate with the same steps in PyTorch and print ratios");
  step->add_option("--threads", options->threads, "CPU threads (default: every core)")->check(CLI::Range(1, 4096));
  step->add_option("--repeats", options->repeats, "rounds; figures are medians of them")->check(CLI::Range(1, 1000));
  step->add_option("--size", options->size, "full, or tiny: narrow networks and few rays, for tests");
  step->add_option("--set", options->set, "override a value of both networks: --set runtime.gemm=onednn")
      ->expected(1)
      ->take_all();
  step->add_option("--peer-script", options->peer_script, "the PyTorch script (default: the shipped one)");
  step->add_option("--python", options->python, "interpreter with torch (default: python3)");
  step->callback(
      [&context, &choice, options] { choice = [&context, options] { return run_bench_step(*options, context); }; });
}

void add_check_numerics(CLI::App& root, AppContext& context, Choice& choice) {
  auto options = std::make_shared<CheckNumericsOptions>();
  CLI::App* verb = root.add_subcommand("check-numerics", "check stiff and extreme cases against their references");
  verb->add_option("--only", options->only, "case ids or prefixes of them: --only A,C03")->delimiter(',');
  verb->add_option("--write", options->page,
                   "page whose marked part is replaced by the table, such as docs/evidence/numerics.md");
  verb->callback(
      [&context, &choice, options] { choice = [&context, options] { return run_check_numerics(*options, context); }; });
}

void add_bench_leave_out(CLI::App& root, AppContext& context, Choice& choice) {
  auto options = std::make_shared<LeaveOutOptions>();
  CLI::App* verb = root.get_subcommand("bench")->add_subcommand(
      "pairs", "compare runs that leave a component out with runs that keep it: the proof, and what it saves");
  verb->add_option("--only", options->only, "pairs to run (default: all)")->expected(1)->take_all();
  verb->add_option("--rounds", options->rounds, "number of alternating timed rounds (default: 9)")
      ->check(CLI::Range(1, 1000));
  verb->add_option("--seeds", options->seeds, "runs on each side of a statistical pair (default: 5)")
      ->check(CLI::Range(2, 1000));
  verb->add_option("--steps", options->seed_steps, "steps of each of these runs (default: 400)")
      ->check(CLI::Range(20, 1000000));
  verb->add_option("--set", options->set, "override a value of all pairs: --set train.rays=200")
      ->expected(1)
      ->take_all();
  verb->add_option("--write-docs", options->write_docs,
                   "folder in which leave_out.json and leave_out.md are renewed: docs/reference");
  verb->callback([&context, &choice, options] {
    choice = [&context, options] { return run_bench_leave_out(*options, context); };
  });
}

}  // namespace

int run_command_line(int argc, char** argv, AppContext& context) {
  CLI::App root{"Semfield: neural fields of appearance, geometry and semantics for one scene", "semfield"};
  root.require_subcommand(1);
  root.fallthrough();
  root.add_flag("-q,--quiet", context.quiet, "print no progress and no notes");
  root.add_flag("--json", context.json, "print results as JSON on stdout");
  std::vector<std::string> modules;
  root.add_option("--plugin", modules, "load a plugin module first: FILE.so")->expected(1)->take_all();
  Choice choice;
  add_train(root, context, choice);
  add_run_verbs(root, context, choice);
  add_sweep(root, context, choice);
  add_mesh(root, context, choice);
  add_scene_verbs(root, context, choice);
  add_degrade(root, context, choice);
  add_fuse(root, context, choice);
  add_propagate(root, context, choice);
  add_label_verbs(root, context, choice);
  add_config_verbs(root, context, choice);
  add_runs_verbs(root, context, choice);
  add_plugins_verbs(root, context, choice);
  add_bench_verbs(root, context, choice);
  add_check_numerics(root, context, choice);
  add_bench_leave_out(root, context, choice);
  CLI::App* version = root.add_subcommand("version", "print version, compiler, plugin interface and instruction sets");
  version->callback([&context, &choice] { choice = [&context] { return run_version(context); }; });
  try {
    root.parse(argc, argv);
  } catch (const CLI::ParseError& error) {
    const int code = root.exit(error);
    return code == 0 ? 0 : static_cast<int>(ErrorKind::usage);
  }
  for (const std::string& module : modules) load_module(context.registry, module);
  return choice ? choice() : static_cast<int>(ErrorKind::usage);
}

}  // namespace semfield::app
