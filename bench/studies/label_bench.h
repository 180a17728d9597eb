// A simulated person labels scenes click by click: how many clicks each way of asking needs, and how long an answer
// takes.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "serve/label_loop.h"
#include "session/settings/run_config.h"
#include "studies/study_tools.h"

namespace semfield {

struct LabelBenchOptions {
  std::vector<Acquisition> strategies{Acquisition::random, Acquisition::farthest, Acquisition::entropy,
                                      Acquisition::margin, Acquisition::surface};
  int seeds = 5;  ///< runtime.seed and the ones behind it
  int most_clicks = 300;
  double geometry_s = 30;  ///< training of colour and geometry before the first click
  double between_s = 2;    ///< training between two clicks; 0: geometry stands
};

/// mIoU of held-out views whose clicks are counted.
inline constexpr double kLabelLevels[] = {0.5, 0.6, 0.7};

/// One person at one scene.
struct LabelCourse {
  std::string scene;
  Acquisition how = Acquisition::random;
  int seed = 0;
  std::vector<double> miou;  ///< over the classes that held-out views show, after 1, 2, ... clicks
  std::vector<int> classes;  ///< that have a click, likewise
  std::vector<double> proposal_ms, learn_ms;
  double ece_before = 0, ece_after = 0, temperature = 1;  ///< at the end
  /// Clicks until mIoU reaches a level for the first time; none: it never did.
  std::optional<int> clicks_to(double level) const;
};

/// Opens and trains `config`, whose scene must know the labels of its frames, and lets every strategy label it with
/// each seed, from the same geometry. A pixel that is void in truth is passed over and not counted.
std::vector<LabelCourse> measure_labelling(RunConfig config, const LabelBenchOptions& options, const StudyTools& tools);

/// Answers of a session that trains meanwhile (serve/label_session.h).
struct LabelLatency {
  std::vector<double> overlay_ms;  ///< from a click to the new labels of its view
  double slowdown = 0;             ///< of training, by a page that is open and idle
};
LabelLatency measure_label_latency(RunConfig config, int clicks, double geometry_s, const StudyTools& tools);

/// Clicks that were acknowledged and are not in the log after its writer was killed; `kills` times. To be called before
/// the process has threads.
int count_lost_clicks(int kills);

std::string label_tables(const std::vector<LabelCourse>& courses);
/// "label: clicks60_ours=... slowdown=...": medians over scenes and seeds; a course that never reaches a level counts
/// as one of more clicks than all others.
std::string label_line(const std::vector<LabelCourse>& courses, const LabelLatency& latency, int lost, int kills);
std::string label_json(const std::vector<LabelCourse>& courses, const LabelLatency& latency);
/// What label_json wrote: courses are added, and the latency is that of the last text that has one. Throws Error(data)
/// naming `name`.
void read_label_json(const std::string& text, const std::string& name, std::vector<LabelCourse>& courses,
                     LabelLatency& latency);

}  // namespace semfield
