// Seconds to open a scene, with all threads and with one, and the memory that it holds.
//
//   scene_open CONFIG.yaml [key=value ...]
//
// Opens the configuration's scene as training does, alternating between one thread and all of them (results are the
// same), and prints medians. Exits with 1 when the two scenes differ, so that nothing wrong is ever timed. The second
// and later rounds read from the system's file cache; the first is printed apart.
#include <sys/resource.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

#include "compute/parallel.h"
#include "loading/frame_source.h"
#include "plugin/loader.h"
#include "session/settings/run_config.h"

namespace {

using namespace semfield;

constexpr int kRepeats = 5;

struct Opened {
  LoadedScene scene;
  double seconds = 0;
};

Opened open_on(const RunConfig& config, int threads) {
  set_thread_count(threads);
  SceneLoadOptions load = config.load;
  load.depth = DepthKept::test;
  DatasetBuild build;
  build.config_dir = config.base_dir;
  Diagnostics diagnostics;
  const auto begin = std::chrono::steady_clock::now();
  const std::unique_ptr<Dataset> dataset = config.dataset.entry->dataset(*config.dataset.params, build);
  Opened out{load_scene(*dataset, load, diagnostics), 0};
  out.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  diagnostics.throw_if_errors(ErrorKind::data, "the scene has problems:");
  return out;
}

bool same(const LoadedScene& a, const LoadedScene& b) {
  for (std::size_t i = 0; i < a.frames.size(); ++i) {
    if (a.frames[i].rgb != b.frames[i].rgb || a.frames[i].label != b.frames[i].label ||
        a.frames[i].depth_m != b.frames[i].depth_m)
      return false;
  }
  return a.class_pixels == b.class_pixels && a.far_m == b.far_m;
}

double median(std::vector<double> v) {
  std::sort(v.begin(), v.end());
  return v[v.size() / 2];
}

double peak_mb() {
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  return static_cast<double>(usage.ru_maxrss) / 1024;
}

int measure(const std::string& path, const std::vector<std::string>& overrides) {
  Registry registry;
  register_linked_plugins(registry);
  const RunConfig config = load_run_config(path, overrides, registry);
  double held_mb = 0, peak_of_one_mb = 0, first_s = 0;
  std::size_t frames = 0;
  int width_px = 0, height_px = 0;
  std::vector<double> one, all;
  for (int i = 0; i < kRepeats; ++i) {
    const Opened parallel = open_on(config, 0);
    if (i == 0) {
      first_s = parallel.seconds;
      peak_of_one_mb = peak_mb();
      frames = parallel.scene.frames.size();
      width_px = parallel.scene.frames.at(0).width_px;
      height_px = parallel.scene.frames.at(0).height_px;
      for (const StoredFrame& frame : parallel.scene.frames) held_mb += static_cast<double>(frame.bytes()) / (1 << 20);
    }
    const Opened serial = open_on(config, 1);
    if (!same(serial.scene, parallel.scene)) {
      std::fprintf(stderr, "one thread and %d read different scenes\n", hardware_threads());
      return EXIT_FAILURE;
    }
    one.push_back(serial.seconds);
    all.push_back(parallel.seconds);
  }
  const double count = static_cast<double>(frames);
  std::printf("%zu frames of %d x %d, %.0f MB held (%.2f MB per frame), %.0f MB at most in the process\n", frames,
              width_px, height_px, held_mb, held_mb / count, peak_of_one_mb);
  std::printf("first open, %d threads: %.2f s\n", hardware_threads(), first_s);
  std::printf("again, %d threads: %.2f s, %.0f frames/s; 1 thread: %.2f s, %.0f frames/s; ratio %.2f\n",
              hardware_threads(), median(all), count / median(all), median(one), count / median(one),
              median(one) / median(all));
  return EXIT_SUCCESS;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 2) {
    std::fprintf(stderr, "usage: scene_open CONFIG.yaml [key=value ...]\n");
    return EXIT_FAILURE;
  }
  try {
    return measure(argv[1], {argv + 2, argv + argc});
  } catch (const std::exception& e) {
    std::fprintf(stderr, "scene_open: %s\n", e.what());
    return EXIT_FAILURE;
  }
}
