// A scene out of a video or of photographs: images, and a COLMAP model of their poses; the ladder of attempts by which
// photographs get poses, and what is said of those that get none.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "core/files.h"
#include "scene/loading/capture/photographs.h"
#include "scene/loading/colmap_model.h"

namespace semfield {

class PrepareState {
 public:
  /// Reads `file` where it is there. `identity` is a text of all that steps depend on. Throws Error(cannot_create) for
  /// a file of another identity, whose steps would be mixed with ours.
  PrepareState(std::string file, std::string identity);

  /// What mark() was given for the step; null where it is not done. Valid until the next mark().
  const std::string* done(const std::string& step) const;
  /// The lines of that; none where the step is not done.
  std::vector<std::string> lines(const std::string& step) const;
  /// The step is done, with what it found as lines of text.
  void mark(const std::string& step, const std::string& found = {});
  /// The step is to be done again.
  void forget(const std::string& step);

 private:
  void write() const;
  std::string file_, identity_;
  std::map<std::string, std::string> steps_;  // what each found
};

/// The folder of a scene that is being prepared: scene/prepare/ with its steps, logs and work. Held for as long as this
/// lives.
class PrepareFolder {
 public:
  /// `scene` is created, or is one that this began. Throws Error(cannot_create) for a folder of others, and where
  /// another process prepares it.
  explicit PrepareFolder(const std::string& scene);
  /// The steps of a scene that is made from all that `text` says; PrepareState says when it throws.
  PrepareState steps(const std::string& text) const;
  std::string work() const { return prepare_ + "/work"; }
  std::string logs() const { return prepare_ + "/log"; }

 private:
  std::string prepare_;
  FolderLock lock_;
};

// COLMAP's programs, one call a step: what words they get, and how far their logs say they are.

/// How features are found and what is asked of them; a ladder of them stands in prepare.cpp.
struct FeatureSettings {
  std::string name;      ///< of its folder and logs
  std::string lens;      ///< COLMAP's name of the camera model that is fitted
  double focal = 0;      ///< to begin with, in longer sides of the image, where the photographs state none
  int size_px = 0;       ///< of the longer side at which features are sought
  int features = 0;      ///< of an image, at most
  int orientations = 1;  ///< of a feature, each of which counts as one more
  double contrast = 0;   ///< least, of a feature [Lowe04]
};

using Pair = std::pair<std::size_t, std::size_t>;
/// Every pair of `count` images, neighbours first: pairs that share features come early.
std::vector<Pair> all_pairs(std::size_t count);
/// Each image with the ten behind it, and with those 16, 32, ... behind; and every pair of some 50 spread evenly, which
/// closes loops without a vocabulary.
std::vector<Pair> pairs_in_order(std::size_t count);

class ColmapSteps {
 public:
  /// `work` is the folder of all that COLMAP writes, `logs` that of its logs. `programs` and `progress` outlive this.
  ColmapSteps(const Programs& programs, const CaptureProgress& progress, std::string images, std::string work,
              std::string logs, int threads)
      : programs_(programs),
        progress_(progress),
        images_(std::move(images)),
        work_(std::move(work)),
        logs_(std::move(logs)),
        threads_(threads) {}

  /// Into a new database: COLMAP that goes on in one it has begun gives the other images a camera of their own.
  void extract(const FeatureSettings& settings, bool camera_per_folder, std::size_t images) const;
  /// Pairs that are in the database already are passed over.
  void match(const FeatureSettings& settings, const std::vector<std::string>& names,
             const std::vector<Pair>& pairs) const;
  /// extract() and match(), unless an earlier call of the program did and the database is still there: the steps
  /// "features" and "matches", each with `suffix`.
  void need_matches(const FeatureSettings& settings, const std::vector<std::string>& names, bool camera_per_folder,
                    const std::function<std::vector<Pair>()>& pairs, PrepareState& state,
                    const std::string& suffix) const;
  /// Folders of the models that were found, in the order of their names; none where no two images begin one. `relaxed`
  /// asks less of each image that joins.
  std::vector<std::string> map(const FeatureSettings& settings, bool relaxed, std::size_t images) const;
  /// A program of COLMAP with these words, that makes the model `to` of the model `from`; the log is called `name`.
  void model_step(const std::string& name, const std::string& from, const std::string& to,
                  std::vector<std::string> words) const;
  /// File of what extract() and match() found.
  std::string database(const FeatureSettings& settings) const;

 private:
  std::string log(const std::string& name) const;
  /// COLMAP with these words; `done` says how far of `total` it is.
  void run(std::vector<std::string> words, const std::string& log, const CaptureStep& step,
           const std::function<double()>& done, std::size_t total) const;
  const Programs& programs_;
  const CaptureProgress& progress_;
  std::string images_, work_, logs_;
  int threads_;
};

/// The whole number behind the last `before` in a log: how far a program is. 0 where there is none.
double last_number_after(const std::string& text, const std::string& before);

/// A model that COLMAP made.
struct FoundModel {
  std::string folder;
  std::vector<std::string> images;  ///< names, sorted
  std::size_t points = 0;
  double error_px = 0;  ///< mean reprojection error
  bool bent = false;    ///< a perspective lens that bends the border of an image as only wide lenses do
};

inline constexpr int kMostAttempts = 4;

struct ReconstructTask {
  std::vector<std::string> names;  ///< of the images, in the order in which they were taken
  bool in_order = false;           ///< frames of a film: neighbours are neighbours
  bool camera_per_folder = false;
  std::string work;      ///< folder
  bool fisheye = false;  ///< its lens took the photographs; false: a perspective one, until no attempt is enough
  int attempts = 0;      ///< at most; 0: those of an earlier call that ended with a model, or kMostAttempts
  /// Told of an attempt that was not enough, before the next.
  std::function<void(const std::string&)> note = [](const std::string&) {};
};

struct Reconstruction {
  FoundModel best;                     ///< of all attempts, refined
  std::vector<FoundModel> others;      ///< of the attempt that found it
  std::vector<std::string> misplaced;  ///< names of images that it was found with at a wrong place; not in it
  int attempts = 0;
};

/// From the cheapest attempt to the most patient, until 95 % of the images have a pose under a lens that fits, which
/// misses their points by at most 1.1 pixels and bends their borders by at most 15 %: features at 1,024 pixels; asking
/// less of an image that joins; more and fainter features at 1,600 pixels, every pair, and a richer lens; the same with
/// a fisheye's. Asked for a fisheye, all attempts have one. The largest model of all is settled. Pairs
/// are all pairs up to 150 photographs, beyond and in films those of pairs_in_order(). Throws Error(data) where nothing
/// was found.
Reconstruction reconstruct(const ReconstructTask& task, const ColmapSteps& colmap, PrepareState& state);

/// Images without a pose that follow each other, and what to do.
struct Missing {
  std::size_t first = 0, last = 0;  ///< places among all names, from 0
  std::string text;                 ///< "photographs 12 to 19 (a.jpg to h.jpg) share too little ...: take some between"
};
/// `blurred` are names of blurred images among those that are missing.
std::vector<Missing> missing_images(const std::vector<std::string>& names, const Reconstruction& found,
                                    const std::vector<std::string>& blurred);

// Images that structure from motion took for a place that looks the same.

/// Names of images of a model, sorted, that stand where the photographs before and after them deny it: a run of at most
/// three of `names` jumps away and back, by five times the step between its two neighbours and the usual step, and it
/// shares hardly a point with them, while they share many with each other or it sees less than half of the usual number
/// of points. `names` is the order in which all images were taken; an order that is none gives no such neighbours.
std::vector<std::string> misplaced_images(const ColmapModel& model, const std::vector<std::string>& names);
/// Names of images, sorted, that see in `kept`, a part of `model`, less than 60 % of the points that they see in
/// `model`: their place hardly fits what they show.
std::vector<std::string> torn_images(const ColmapModel& model, const ColmapModel& kept);

// A scene out of a video or of photographs: images, and a COLMAP model of their poses.

struct PrepareOptions {
  std::string source;      ///< a video, or a folder of photographs; never written to
  std::string out;         ///< folder of the scene
  std::size_t frames = 0;  ///< of a video, at most; 0: as VideoCut
  int threads = 0;         ///< 0: every core
  bool fisheye = false;    ///< as ReconstructTask
  int attempts = 0;        ///< to give every photograph a pose, at most; 0: as ReconstructTask
  std::function<void(const std::string&)> note = [](const std::string&) {};  ///< of an attempt that was not enough
};

struct PrepareReport {
  std::size_t photographs = 0, registered = 0, points = 0;
  std::int32_t width_px = 0, height_px = 0;  ///< of the first
  double error_px = 0;                       ///< mean reprojection error
  int attempts = 0;
  std::string cut;  ///< what was kept of a video; empty of photographs
  std::vector<Missing> missing;
  Diagnostics findings;  ///< of the photographs; no errors
};

/// Writes `out`: images/ with copies of the photographs under plain names, and sparse/0/, which appears when all is
/// done. prepare/ holds the steps that are done, by which a run that was ended goes on, and the logs of all programs.
/// Throws Error for a source that cannot be used, a folder of others, a program that is missing or fails.
PrepareReport prepare_scene(const PrepareOptions& options, const Programs& programs, const CaptureProgress& progress);

}  // namespace semfield
