// Names that look alike: one character, or a letter and its marks.
#pragma once

#include <string>
#include <string_view>

namespace semfield {

/// The text with its composed characters taken apart [Unicode, NFD]: two names that look the same, of which macOS wrote
/// one and another system the other, are equal so. Of the Basic Multilingual Plane without compatibility ideographs;
/// marks keep the order in which they stand, and bytes that are no UTF-8 stay as they are.
std::string decomposed(std::string_view text);

}  // namespace semfield
