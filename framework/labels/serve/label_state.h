// What a labelling session tells whoever looks.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "labels/clicks.h"

namespace semfield {

struct ClassState {
  int index = 0;
  int id = 0;
  std::string name;
  std::array<std::uint8_t, 3> color{};
  int clicks = 0;
  double area_share = 0;  ///< of the surface that the views show
  double confidence = 0;  ///< mean over its area, after temperature
  bool own = false;       ///< of the scene's table: not to be renamed, merged or deleted
};

struct ViewState {
  std::string frame;
  std::int32_t width_px = 0, height_px = 0;
  int clicks = 0;
  double entropy = 0;     ///< mean over its pixels, as a fraction of the largest there can be
  bool ready = false;     ///< its surface is known, so it has labels
  std::string photo;      ///< a checksum of its photograph
  bool held_out = false;  ///< a test frame, which is only looked at
};

struct ProposalState {
  std::string id;
  int view = 0;
  PixelPoint at;         ///< pixels of the view
  std::string why;       ///< "unseen" or "uncertain"
  int class_guess = -1;  ///< index; -1: none
};

/// A moment of a session; never changed once it is out.
struct LabelState {
  std::uint64_t revision = 0;          ///< grows with every change
  std::uint64_t overlay_revision = 0;  ///< of the labels of views
  std::uint64_t overlay_events = 0;    ///< events that those labels know; `events`: all
  std::uint64_t events = 0;
  std::string name, run_dir, device;
  std::int64_t step = 0;
  double train_s = 0, loss = 0, psnr_db = 0, rays_per_s = 0;
  bool geometry_ready = false;
  double unreached = 1;  ///< share of the surface that is far from every click, ProposalRules::unseen
  std::string phase;     ///< a short sentence
  int named = 0, room = 0;
  double temperature = 1;
  std::vector<ClassState> classes;  ///< the named ones
  std::vector<ViewState> views;
  std::optional<ProposalState> proposal;
  std::vector<Annotations::Mark> marks;  ///< Mark::frame: a frame of the scene; see LabelSession::view_of
  std::vector<std::string> notes;        ///< warnings of the scene and the run
  std::string trouble;  ///< not empty: files of the run could not be written; it goes on, and tries again
  std::string failure;  ///< not empty: training has ended with this; what was labelled is safe
};

}  // namespace semfield
