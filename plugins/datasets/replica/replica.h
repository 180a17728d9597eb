// Pre-rendered Replica sequences: traj_w_c.txt, rgb/, depth/, semantic_class/, semantic_instance/; or as NICE-SLAM
// renders them: traj.txt, results/frame*.jpg and depth*.png.
#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <vector>

#include "config/params.h"
#include "loading/frame_files.h"
#include "plugin/dataset.h"

namespace semfield {

enum class ReplicaSplit { by_steps, paper };
SEMFIELD_CHOICES(ReplicaSplit, "auto", "paper");

struct ReplicaParams {
  std::string root;
  std::string sequence;
  double hfov_deg = 90;
  std::string label_dir = "semantic_class";
  std::string test_label_dir;
  std::string classes;
  UnknownLabels unknown_labels = UnknownLabels::error;
  MissingFiles missing = MissingFiles::error;
  ReplicaSplit split = ReplicaSplit::by_steps;
  std::int32_t test_every = 8;
  std::int32_t train_step = 0;
  std::int32_t train_offset = 0;
  std::int32_t test_step = 0;
  std::int32_t test_offset = 0;
};
void describe(ParamVisitor& visit, ReplicaParams& params);
void validate(const ReplicaParams& params, Diagnostics& diagnostics);
std::string recognise(const std::string& path, ReplicaParams& params);

class Replica final : public Dataset {
 public:
  Replica(const ReplicaParams& params, const DatasetBuild& build);
  SceneInfo open(Diagnostics& diagnostics) override;
  void read(int frame, FrameBuffer& out) const override;

 private:
  struct Row {
    int number = 0;  ///< <i> of rgb_<i>.png
    Pose pose;
  };
  std::string sequence_folder();
  std::string color_folder() const { return slam_ ? "results" : "rgb"; }
  const char* color_prefix() const { return slam_ ? "frame" : "rgb_"; }
  const char* trajectory_file() const { return slam_ ? "traj.txt" : "traj_w_c.txt"; }
  Camera camera_of(const std::string& folder, const std::vector<Row>& trajectory, Diagnostics& diagnostics);
  std::vector<Row> read_trajectory(const std::string& path, Diagnostics& diagnostics, std::size_t& rows) const;
  Split split_of(int number) const;
  void check_poses_for_images(const std::string& folder, std::size_t rows, Diagnostics& diagnostics) const;
  FrameFiles files_of(const std::string& folder, int number, Split split) const;
  void index_labels(const std::string& folder, Diagnostics& diagnostics);
  std::string label_of(int number, Split split) const;
  void report_unlabelled(const std::string& folder, Diagnostics& diagnostics) const;

  ReplicaParams params_;
  std::string root_;
  std::string class_file_;
  bool slam_ = false;  ///< in the layout of NICE-SLAM
  double depth_unit_m_ = 0.001;
  std::map<std::string, std::map<int, std::string>> label_files_;  ///< folder as in the parameters -> <i> -> path
  SceneInfo info_;
  std::vector<FrameFiles> files_;
};

}  // namespace semfield
