// Classes that events add, rename, merge and delete, and events that are undone.
#include <algorithm>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "labels/clicks/annotations.h"
#include "scene/classes/class_table.h"

namespace semfield {

int Annotations::resolve_added_class(const LabelEvent& event, const char* remedy) const {
  const int c = resolve_class(event, event.class_name);
  if (c == kVoid)
    refuse_event("labels.event.void", event, "'" + event.class_name + "' stands for pixels without a class");
  if (c < own_classes_)
    refuse_event("labels.event.own_class", event, "the class '" + event.class_name + "' is one of the scene's own",
                 remedy);
  return c;
}

void Annotations::require_free_name(const LabelEvent& event, const std::string& name, const char* remedy) const {
  for (const ClassEntry& entry : classes_.entries()) {
    const int c = classes_.index_of(entry.id);
    if (entry.name == name && (c == kVoid || is_named(c)))
      refuse_event("labels.event.taken", event, "there is a class '" + name + "' already", remedy);
  }
  if (is_void_name(name) || is_unnamed_class(name))
    refuse_event("labels.event.void", event, "'" + name + "' stands for pixels and classes without a name", remedy);
}

Annotations::Turned Annotations::turned_by(int of) const {
  Turned turned{{of}, !records_[static_cast<std::size_t>(of)].in_force};
  while (records_[static_cast<std::size_t>(turned.records.back())].of >= 0) {
    turned.records.push_back(records_[static_cast<std::size_t>(turned.records.back())].of);
    turned.in_force = !turned.in_force;
  }
  return turned;
}

const Annotations::Record* Annotations::end_of_class(int added) const {
  for (auto end = ends_.rbegin(); end != ends_.rend() && *end > added; ++end) {
    const Record& e = records_[static_cast<std::size_t>(*end)];
    if (e.in_force && (e.class_record == added || e.into_record == added)) return &e;
  }
  return nullptr;
}

void Annotations::check_undo(const LabelEvent& event) const {
  const auto found = record_of_.find(event.of);
  if (found == record_of_.end())
    refuse_event("labels.event.undo", event, "there is no event '" + event.of + "' to undo");
  if (!records_[static_cast<std::size_t>(found->second)].in_force)
    refuse_event("labels.event.undo", event, "event '" + event.of + "' is undone already",
                 "undo its undo to bring it back");
  const Turned turned = turned_by(found->second);
  const int last = turned.records.back();
  const Record& record = records_[static_cast<std::size_t>(last)];
  if (record.event.kind == LabelEventKind::skip) return;
  if (record.event.kind != LabelEventKind::click) return check_class_undo(event, turned);
  if (!turned.in_force) return;
  const bool is_deleted = !class_now(last).has_value();
  if (is_deleted || !has_its_class(record))
    refuse_event("labels.event.undo", event,
                 "the class '" + record.event.class_name + "' of this click is " + (is_deleted ? "deleted" : "undone"),
                 "bring the class back first");
}

void Annotations::check_class_undo(const LabelEvent& event, const Turned& turned) const {
  const Record& last = records_[static_cast<std::size_t>(turned.records.back())];
  const auto c = static_cast<std::size_t>(last.class_index);
  if (last.event.kind == LabelEventKind::add_class && !turned.in_force) {
    if (const Record* const end = end_of_class(turned.records.back()))
      refuse_event("labels.event.undo", event, "the class '" + last.event.class_name + "' was merged or deleted since",
                   "undo event '" + end->event.id + "' first");
    const auto uses = [&](const Mark& mark) { return mark.class_index == last.class_index; };
    const auto clicks = std::count_if(marks().begin(), marks().end(), uses);
    if (clicks > 0) {
      refuse_event("labels.event.undo", event,
                   "the class '" + named_[c]->name + "' has " + std::to_string(clicks) + " clicks",
                   "undo its clicks first");
    }
  }
  const bool ends = ends_a_class(last.event.kind);
  if (ends && turned.in_force) {
    const auto is_there = [&](int of, int added) { return is_named(of) && record_of_class(of) == added; };
    const bool has_own = is_there(last.class_index, last.class_record);
    if (!has_own || (last.into >= 0 && !is_there(last.into, last.into_record)))
      refuse_event("labels.event.undo", event,
                   "the class '" + (has_own ? last.event.new_name : last.event.class_name) + "' is no longer there",
                   "bring the class back first");
  }
  const bool comes_back = last.event.kind == LabelEventKind::add_class ? turned.in_force : ends && !turned.in_force;
  if (comes_back && named_[c]) {
    refuse_event("labels.event.undo", event,
                 "the place of the class '" + last.event.class_name + "' has been given to '" + named_[c]->name + "'",
                 "add the class again, or undo '" + named_[c]->name + "' first");
  }
  const std::optional<Naming> after = namings(turned.records.back())[c];
  if (after && (!named_[c] || named_[c]->name != after->name))
    require_free_name(event, after->name, "rename one of the two first");
}

// One that never had a name while there is one, so that an undone class can come back; -1: none.
int Annotations::free_place() const {
  if (named_.size() < ids_.size()) return named_classes();
  const auto undone = std::find_if(named_.begin(), named_.end(), [](const auto& naming) { return !naming; });
  return undone == named_.end() ? -1 : static_cast<int>(undone - named_.begin());
}

// Clicks anew: their classes were merged or deleted, or are no longer so.
void Annotations::list_marks() {
  marks_ = {};
  for (int r = 0; r < static_cast<int>(records_.size()); ++r) {
    const Record& record = records_[static_cast<std::size_t>(r)];
    if (record.in_force && record.event.kind == LabelEventKind::click) put_mark(r, true);
  }
}

// With the record `turned`, if any, taken out or put back.
std::vector<std::optional<Annotations::Naming>> Annotations::namings(int turned) const {
  std::vector<std::optional<Naming>> out;
  for (const ClassEntry& entry : own_) {
    if (!entry.ignore) out.emplace_back(Naming{entry.name, entry.color});
  }
  out.resize(named_.size());
  for (int r = 0; r < static_cast<int>(records_.size()); ++r) {
    const Record& record = records_[static_cast<std::size_t>(r)];
    if (record.in_force == (r == turned) || record.class_index < 0) continue;
    if (record.class_record >= 0 && record.class_record != turned && !has_its_class(record)) continue;
    std::optional<Naming>& naming = out[static_cast<std::size_t>(record.class_index)];
    if (record.event.kind == LabelEventKind::add_class) naming = Naming{record.event.class_name, record.event.color, r};
    if (ends_a_class(record.event.kind)) naming.reset();
    if (record.event.kind != LabelEventKind::change_class || !naming) continue;
    naming->name = record.event.new_name;
    if (record.event.color) naming->color = record.event.color;
  }
  return out;
}

void Annotations::list_classes() {
  named_ = namings();
  std::vector<ClassEntry> entries;
  for (const ClassEntry& entry : own_) {
    if (entry.ignore) entries.push_back(entry);
  }
  for (std::size_t c = 0; c < ids_.size(); ++c) {
    const bool named = c < named_.size() && named_[c];
    entries.push_back({ids_[c], named ? named_[c]->name : unnamed_class(ids_[c]),
                       named && named_[c]->color ? *named_[c]->color : ClassTable::default_color(ids_[c]), false});
  }
  classes_ = ClassTable(std::move(entries));
}

ClassTable Annotations::named_table() const {
  std::vector<ClassEntry> entries;
  for (const ClassEntry& entry : classes_.entries()) {
    if (entry.ignore || is_named(classes_.index_of(entry.id))) entries.push_back(entry);
  }
  return ClassTable(std::move(entries));
}

}  // namespace semfield
