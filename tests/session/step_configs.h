// Configurations of the steps that tests compare: labels of few frames, branches, terms of the loss.
#pragma once

#include "tests/session/train_testing.h"

namespace semfield::testing_train {

inline std::string few_labels_config(const std::string& more) {
  return with_scene(two_pass_config(more), "{type: analytic_room, labels: {frames: 50%}}");
}
inline std::string branch_config(const std::string& more) {
  std::string yaml = hash_config();
  const std::string branch =
      "    semantic: {position: {type: frequency, frequencies: 4}, field: {type: tiny_mlp, "
      "hidden_width: 24, hidden_layers: 2}" +
      more + "}\n";
  return yaml.insert(yaml.find("train: "), branch);
}
inline std::string label_rays_config(const std::string& more) {
  return replaced(few_labels_config(""), "train: {", "train: {" + more);
}
inline const char* const kTerms =
    "losses: [{type: depth, weight: 0.3}, {type: distortion, weight: 0.2, from_step: 0}, {type: near_density, weight: "
    "0.1, from_step: 0, distance_m: 0.8}]\n";
inline std::string branch_and_terms_config(const std::string& more) { return branch_config("") + more; }

/// Poses and colours of the training cameras are learned.
inline std::string learned_cameras(std::string yaml) {
  return yaml.replace(
      yaml.find("train: {"), 8,
      "train: {cameras: {poses: learned, colors: learned, pose_rate: 0.5, color_rate: 0.5, from_step: 0}, ");
}
inline std::string cameras_config(const std::string& more) { return learned_cameras(hash_config(more)); }
inline std::string contracted_cameras_config(const std::string& more) {
  return replaced(cameras_config(more), "rendering: {", "rendering: {outside: contracted, ");
}
inline std::string two_pass_cameras_config(const std::string& more) { return learned_cameras(two_pass_config(more)); }

/// A head of the channel `albedo`, which the room offers, with a branch of its own.
inline std::string head_lists(const std::string& of_head, const std::string& of_branch) {
  return "heads: [{type: feature_map, channel: albedo, hidden_width: 11" + of_head +
         ", branch: {position: {type: frequency, frequencies: 3}, field: {type: tiny_mlp, hidden_width: 16, "
         "hidden_layers: 2}" +
         of_branch + "}}]\nlosses: [{type: cosine_distance, channel: albedo, weight: 0.7}]\n";
}
inline std::string with_albedo(const std::string& yaml) {
  return with_scene(yaml, "{type: analytic_room, with_albedo: true}");
}
inline std::string head_config(const std::string& of_branch) {
  return with_albedo(hash_config(head_lists("", of_branch)));
}
inline std::string two_pass_head_config(const std::string& of_head) {
  return with_albedo(two_pass_config(head_lists(of_head, ", reads_feature: true")));
}
inline std::string branch_and_head_config(const std::string& of_branch) {
  return with_albedo(branch_config("") + head_lists("", of_branch));
}

/// Steps of every kind that a configuration can ask for.
struct StepCase {
  const char* name;
  std::string (*config)(const std::string&);
  const char* more;
};
inline const StepCase kStepCases[] = {
    {"two_pass", two_pass_config, ""},
    {"hash", hash_config, ""},
    {"closed", two_pass_config, "rendering: {far: closed, background: [0.2, 0.5, 0.9]}\n"},
    {"background", two_pass_config, "rendering: {far: background, density_activation: softplus}\n"},
    {"trunc_exp", two_pass_config, "rendering: {density_activation: trunc_exp, density_bias: -1}\n"},
    {"noise", two_pass_config, "rendering: {density_noise: 1}\n"},
    {"few_labels", few_labels_config, ""},
    {"label_rays_apart", label_rays_config,
     "ray_source: label_balanced, labelled_share: 0.3, label_rays_teach_color: false, "},
    {"branch", branch_config, ""},
    {"branch_of_position", branch_config, ", reads_feature: false, least_weight: 0.03"},
    {"branch_with_dropout", branch_config, ", dropout: 0.3, weight_decay: 0.1, learning_rate: 0.2"},
    {"terms", two_pass_config, kTerms},
    {"terms_hash", hash_config, kTerms},
    {"terms_and_branch", branch_and_terms_config, kTerms},
    {"head", head_config, ""},
    {"head_with_dropout", head_config, ", dropout: 0.3, weight_decay: 0.1, learning_rate: 0.2"},
    {"head_of_the_feature", two_pass_head_config, ""},
    {"head_on_principal_axes", two_pass_head_config, ", width: 2"},
    {"head_beside_a_branch", branch_and_head_config, ", reads_feature: true"},
    {"cameras", cameras_config, ""},
    {"cameras_contracted", contracted_cameras_config, ""},
    {"cameras_two_pass", two_pass_cameras_config, kTerms},
    {"line_of_sight", two_pass_config, "losses: [{type: depth, kind: line_of_sight, weight: 0.3}]\n"},
};
inline std::string name_of_step(const ::testing::TestParamInfo<StepCase>& row) { return row.param.name; }

}  // namespace semfield::testing_train
