// COLMAP's programs, one call a step: what words they get, and how far their logs say they are.
#pragma once

#include <cstddef>
#include <functional>
#include <string>
#include <utility>
#include <vector>

#include "loading/capture/programs.h"

namespace semfield {

/// How features are found and what is asked of them; a ladder of them stands in reconstruct.cpp.
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
  /// Folders of the models that were found, in the order of their names; none where no two images begin one. `relaxed`
  /// asks less of each image that joins.
  std::vector<std::string> map(const FeatureSettings& settings, bool relaxed, std::size_t images) const;
  /// The model `from` without these images, into `to`.
  void remove(const std::string& from, const std::vector<std::string>& names, const std::string& to) const;
  /// The model `from` without what misses its point by over `most_px` pixels, into `to`; its errors are those that are
  /// left.
  void filter(const std::string& from, double most_px, const std::string& to) const;
  /// Images of the database that have no pose get one among the points of `from` where enough of these say so, into
  /// `to`.
  void place(const FeatureSettings& settings, const std::string& from, const std::string& to) const;
  /// The model `from` with OPENCV lenses or fisheyes, into `to`.
  void free_lenses(const std::string& from, const std::string& to) const;
  /// All poses, points and lenses of the model `from` at once, into `to`. The errors in its files stay those of `from`.
  void adjust(const std::string& from, const std::string& to) const;

  /// File of what extract() and match() found.
  std::string database(const FeatureSettings& settings) const;

 private:
  std::string log(const std::string& name) const;
  void model_step(const std::string& name, const std::string& from, const std::string& to,
                  std::vector<std::string> words) const;
  const Programs& programs_;
  const CaptureProgress& progress_;
  std::string images_, work_, logs_;
  int threads_;
};

/// The whole number behind the last `before` in a log: how far a program is. 0 where there is none.
double last_number_after(const std::string& text, const std::string& before);

}  // namespace semfield
