// Tuning: which settings a scene's own held-out training views ask for. A space of axes, a race over them, what of the
// winner can be left out, and the configuration and tables that say so. Cells are those of a sweep.
#pragma once

#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "config/config_tree.h"
#include "config/config_words.h"
#include "eval/report/sweep.h"
#include "plugin/registry.h"

namespace semfield {

struct TuneValue {
  std::string name;                 ///< "rays 4096", or a variant's own
  std::vector<ConfigOverride> set;  ///< losses are called by their type, and one that is missing is added
};

struct TuneAxis {
  std::string name;
  std::vector<TuneValue> values;
  bool is_part = false;  ///< its value takes a part of the configuration out: for the end of the race alone
};

/// Reads `axes:` of a file (docs/guide/tuning.md). Throws Error(config) with every error on its own line.
std::vector<TuneAxis> read_tune_space(const std::string& path);

/// An axis for each part that training may do without: losses, learned cameras and colours, a branch for semantics.
std::vector<TuneAxis> optional_parts(const ConfigNode& config);

/// Index of the value of each axis; -1: as configured.
using TuneChoice = std::vector<int>;

struct TuneAim {
  std::string name, metric, unit;
  double least_noise;  ///< differences below are none, however equal the seeds are
  int digits;          ///< to print of a gain
};
/// What can be tuned for: psnr, which any other name means too, miou, depth, time.
std::vector<std::string> tune_aims();
const TuneAim& tune_aim(const std::string& name);

/// What is tuned, and how long.
struct TunePlan {
  ConfigNode config;  ///< composed
  std::string path;   ///< of its file
  std::vector<TuneAxis> axes;
  double time_s = 120;  ///< for the whole race
  double length = 15;   ///< of the training that users will do, seconds or steps
  bool in_steps = false;
  int seeds = 2;
  int at_a_time = 1;
  std::string aim = "psnr";
  int score_stride = 3;  ///< every so many pixels of held-out views, across and down
};

/// Candidates trained for one length, each with the first `seeds` seeds.
struct TuneRound {
  std::string name;
  double length = 0;
  int seeds = 0;
  std::vector<TuneChoice> candidates;  ///< the first is what the others are compared with; none: the round is left out
};

/// What the candidates of a round scored, by candidate and seed; empty where a cell failed.
using TuneScores = std::vector<std::vector<CellValues>>;

/// Who trains the cells of a race.
class TuneWork {
 public:
  virtual ~TuneWork() = default;
  /// What a record says of this round, or the `wanted` one where it says nothing yet: rounds depend on the clock.
  virtual TuneRound agreed(const TuneRound& wanted) = 0;
  /// None after a stop signal.
  virtual std::optional<TuneScores> run(const TuneRound& round) = 0;
  virtual double spent_s() const = 0;  ///< since the race began
  virtual double cell_s() const = 0;   ///< what a cell takes besides training
};

struct TuneGain {
  double mean = 0;  ///< above what it is compared with, in the aim's unit; -infinity: it did not score
  int sure = 0;     ///< seeds in which it is above
  int seeds = 0;
};

/// A difference of the winner, or an optional part.
struct TunePart {
  std::size_t axis = 0;
  TuneGain gain = {};  ///< of having it
  std::string name = {};
  double time_share = 0;  ///< of a step's time that it takes
  bool kept = true;
};

struct TuneOutcome {
  bool whole = false;  ///< false: stopped
  TuneChoice best;
  TuneGain gain;  ///< of the best over the configuration
  double noise = 0;
  std::vector<TunePart> parts;
  std::vector<std::string> notes;  ///< what there was no time for
  std::vector<std::pair<TuneRound, TuneScores>> rounds;
};

/// Where a cell has scored more pixels than tell two candidates apart, a larger stride for those to come.
int score_stride_for(const TunePlan& plan, const CellValues& scored);

ConfigNode with_choice(const TunePlan& plan, const TuneChoice& choice);

/// The rounds of docs/guide/tuning.md.
TuneOutcome race(const TunePlan& plan, TuneWork& work);

/// The cell of a candidate: every eighth training view held out. Throws Error(config) naming the place of a value that
/// the configuration cannot take.
Cell tune_cell(const TunePlan& plan, const TuneChoice& choice, double length, int seed, Registry& registry);

/// `include` and what differs, a line each with its gain; `command` made it.
std::string tuned_config(const TunePlan& plan, const TuneOutcome& outcome, const std::string& include,
                         const std::string& command);
/// The first words of such a file.
inline constexpr std::string_view kTunedBy = "# Tuned by `";

/// "+0.42 dB, sure: 2 of 2 seeds".
std::string gain_text(const TuneAim& aim, const TuneGain& gain);
std::string choice_name(const std::vector<TuneAxis>& axes, const TuneChoice& choice);

/// tables.md, and the data of tune.html for report_page: error against run time, what decided, every round.
std::pair<std::string, std::string> tune_tables(const TunePlan& plan, const TuneOutcome& outcome);

}  // namespace semfield
