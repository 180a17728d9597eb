// The verbs as plain functions; command_line.cpp alone knows CLI11. Results go to stdout, sentences to stderr.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "core/work_scope.h"
#include "plugin/registry.h"
#include "settings/run_config.h"

namespace semfield::app {

/// What every verb gets.
struct AppContext {
  AppContext() { work.limits = &limits; }
  AppContext(const AppContext&) = delete;
  AppContext& operator=(const AppContext&) = delete;
  /// From now on verbs work with the threads and under the limits of `config`.
  void adopt(const RunConfig& config) {
    work.threads = config.runtime.threads;
    limits = config.limits;
  }

  Registry registry;
  InputLimits limits;
  LoadProgress load_progress;
  WorkSettings work;  ///< of the main thread
  bool quiet = false;
  bool json = false;
  bool terminal = false;  ///< stderr is a terminal: one progress line, overwritten
};

/// A configuration, and what `--set a.b=c` and the flags that are short forms of it say.
struct ConfigOptions {
  std::string config;
  std::vector<std::string> set;
};

struct TrainOptions {
  ConfigOptions config;
  std::string out;
  std::string resume;
  std::string time;  ///< "90s", "5m", "1h"
  std::vector<std::string> keep;
  bool dry_run = false;
};
int run_train(const TrainOptions& options, AppContext& context);

struct EvalOptions {
  std::string run, out;
  std::string split = "test";
  std::vector<std::string> set;
};
int run_eval(const EvalOptions& options, AppContext& context);

struct RenderOptions {
  std::string run;
  std::string split = "test";
  std::string trajectory;  ///< file of camera-to-world matrices, or "smooth"; replaces the split
  int frames = 240;        ///< of the smooth path
  std::string out;         ///< default: render/<split> of the run, or render/<split>.mp4
  bool npy = false;
  bool video = false;
  std::string panels;  ///< of the video: "rgb,label,depth,entropy"; "" = all that the run has
  double fps = 24;
  std::vector<std::string> set;
};
int run_render(const RenderOptions& options, AppContext& context);

struct SweepOptions {
  std::string file;
  std::string out;  ///< default: runs/<name>
  std::optional<int> jobs, threads;
  std::optional<double> memory_gb;
  bool keep_checkpoints = false;
  bool dry_run = false;
};
int run_sweep(const SweepOptions& options, AppContext& context);

struct MeshOptions {
  std::string run;
  std::string out;                      ///< default: mesh.ply in the run folder
  std::vector<std::string> formats;     ///< ply, obj, glb; empty: what `out` ends with, or ply
  std::optional<long long> resolution;  ///< cells along the longest side of the bounds
  std::optional<double> voxel;          ///< edge of a cell instead, world units
  std::optional<double> level;          ///< density of the surface, 1/m
  double keep_components = 0.002;       ///< least share of the faces: a chair is one, a floater is not
  bool points = false;                  ///< also a point cloud from the training views
  std::vector<std::string> set;
};
int run_mesh(const MeshOptions& options, AppContext& context);

struct ExportOptions {
  std::string run;
  std::string split = "test";
  std::string format = "coco";  ///< coco, coco_rle or labelme
  std::string out;              ///< file for COCO, folder for labelme
  long long min_area = 0;       ///< pixels; smaller regions take the class around them
  std::vector<std::string> set;
};
int run_export(const ExportOptions& options, AppContext& context);

struct ClassesOptions {
  std::string in;               ///< file, or the name of a published table
  std::string format = "yaml";  ///< yaml, csv or cvat
  std::string ids = "raw";      ///< of ScanNet's table: raw, nyu40 or nyu13
  std::string colors = "keep";  ///< keep, pascal or semfield
  std::string out;              ///< file; "" = stdout
};
int run_classes(const ClassesOptions& options);

int run_report(const std::vector<std::string>& runs, const std::string& out, AppContext& context);

/// 0 when both are the same training, else 1 and the first difference.
int run_runs_equal(const std::string& a, const std::string& b, AppContext& context);

struct FuseOptions {
  ConfigOptions config;
  std::string method;      ///< names with commas; replaces fuse.methods
  std::string depth;       ///< true or learned; replaces fuse.depth
  std::string depth_from;  ///< run folder
  std::string out;
};
int run_fuse(const FuseOptions& options, AppContext& context);

struct PropagateOptions {
  std::string run, out;
  std::vector<std::string> set;
};
int run_propagate(const PropagateOptions& options, AppContext& context);

int run_inspect(const ConfigOptions& options, const std::string& frusta_path, AppContext& context);
int run_capture(const ConfigOptions& options, const std::string& out, AppContext& context);
int run_degrade(const ConfigOptions& options, const std::string& out, AppContext& context);
int run_pack(const ConfigOptions& options, const std::string& out, AppContext& context);

int run_config_check(const ConfigOptions& options, AppContext& context);
int run_config_explain(const ConfigOptions& options, AppContext& context);
int run_config_diff(const std::string& a, const std::string& b, AppContext& context);
/// Of configurations, with the plugins that are loaded, or of sweep files.
int run_config_schema(bool of_sweeps, AppContext& context);

int run_plugins_list(AppContext& context);
int run_plugins_show(const std::string& name, AppContext& context);
int run_plugins_docs(const std::string& out, AppContext& context);
int run_plugins_matrix(AppContext& context);

struct BenchStepOptions;
struct BenchQuadratureOptions {
  long long rays = 1024;  ///< for rules with jitter and media with jumps
  std::string out;        ///< folder for plots, tables and quadrature.json; "": none
};
int run_bench_quadrature(const BenchQuadratureOptions& options, AppContext& context);

int run_bench_step(const BenchStepOptions& options, AppContext& context);

struct BenchGpuOptions {
  bool peers = false;
  std::string only;  ///< beginning of the measurements' names; "": all
  int repeats = 5;
  std::string python;
};
int run_bench_gpu(const BenchGpuOptions& options, AppContext& context);

struct CheckNumericsOptions {
  std::vector<std::string> only;  ///< beginnings of ids; empty: every case
  std::string page;               ///< Markdown page whose marked part the table replaces; "" = none
};
/// 0 when no case failed, else 1.
int run_check_numerics(const CheckNumericsOptions& options, AppContext& context);

struct LeaveOutOptions {
  std::vector<std::string> only;  ///< names of pairs; empty: all
  std::vector<std::string> set;
  std::string write_docs;  ///< folder of leave_out.json and leave_out.md
  int rounds = 9;
  int seeds = 5;
  int seed_steps = 400;
};
int run_bench_leave_out(const LeaveOutOptions& options, AppContext& context);

int run_version(AppContext& context);

void print_note(const AppContext& context, const std::string& text);

}  // namespace semfield::app
