target_sources(semfield PRIVATE ${CMAKE_CURRENT_LIST_DIR}/compositor.cpp ${CMAKE_CURRENT_LIST_DIR}/density_activation.cpp)
